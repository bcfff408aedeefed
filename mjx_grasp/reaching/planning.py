"""Which candidate the arm and hand can reach, and with what posture: IK from a library of starts.

It tells the upper bound of every rate (the share of poses for which there is a solution at all),
and guides selection and reaching in the presets that look ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.linear import full_precision
from mjx_grasp.geometry.signed_distance import Shape
from mjx_grasp.geometry.vectors import dot, norm, unit
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.targets import TargetOptions, admissible, standoffs, target_options
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.clearances import proximities
from mjx_grasp.posture.config import ClearanceConfig
from mjx_grasp.posture.ik import IkSolution, TipGoals, solve_ik
from mjx_grasp.posture.library import Library, Options, build_library, choose_starts
from mjx_grasp.posture.surroundings import Surroundings, stacked
from mjx_grasp.reaching.approach import approaching
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.fields import midpoint, pad_goals
from mjx_grasp.reaching.guide import Guide
from mjx_grasp.reaching.holding import met, opposing
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.plan_costs import (
    FAILED,
    asked_of,
    attempt_costs,
    closing_costs,
    light_enough,
    slip_costs,
)
from mjx_grasp.reaching.state import Plans
from mjx_grasp.reaching.way_out import freer


class Search(NamedTuple):
    """What a search found."""

    plans: Plans
    """the best first; of those that are not ``guide.known`` no attempt succeeded"""
    cost: Float[Array, " p"]
    """time to get there, what is lacking and how far it is from a wish; the less the better [s]"""
    least_error: Float[Array, ""]
    """of all clear solutions, the least of their largest tip errors; +inf if all penetrate
    something [m]"""
    at_limit: Bool[Array, ""]
    """whether the best attempt has a joint at its limit"""


def start_library(body: Body, config: PlanConfig) -> Library:
    """Draws the library of a robot; takes some seconds.

    Raises:
        InputError: The robot does not reach the object area, or not from where it should.
    """
    library = build_library(body, config.library, config.area, config.seed)
    return approaching(body, library, config.approach, config.approach_angle)


class _Ways(NamedTuple):
    """All ways to use the candidates, with the object where it is; world frame."""

    targets: TargetOptions
    options: Options
    """standoff targets, and which of them are admissible"""


def _ways(candidates: Candidates, around: Surroundings, selection: SelectionConfig) -> _Ways:
    config = selection.targets
    options = target_options(candidates, config)
    high = admissible(candidates, options, around.p_wo, around.R_wo, config)
    scores = (candidates.score >= selection.min_score)[options.candidate]
    local = standoffs(options.position, options.normal, config)
    goals = around.p_wo + local @ around.R_wo.T
    pads = jax.vmap(pad_goals)(goals)
    return _Ways(options, Options(TipGoals(goals, pads), high & scores))


class _Try(NamedTuple):
    """Among which candidates a search looks."""

    least: Float[Array, ""] | float
    """score that they have"""
    light: bool = False
    """whether those alone that hold the object with little more force than the best of them"""
    easy: bool = False
    """the same, than the best of all that can be used"""


class _Sought(NamedTuple):
    """A posture that is looked for."""

    goals: TipGoals
    near: tuple[Float[Array, " joints"], Float[Array, " joints"]]
    """where the solver starts, and what it is to stay near [rad]"""


class _Wish(NamedTuple):
    """What the scores of candidates ask for where the object lies."""

    near: list[Float[Array, ""]]
    """for each number of `PlanConfig.at_least` the least score with which so many can be used, or
    all that have one, where there are fewer"""
    held: Float[Array, ""]
    """the same for the first number, of those that hold the object easily"""
    easy: Bool[Array, " v"]
    """which these are"""
    far: Float[Array, " v"]
    """of all that can be used the share that has a higher score than a candidate [-]"""


def _gripping(
    plan: PlanConfig, options: TargetOptions, usable: Bool[Array, " o"], shape: Shape
) -> Bool[Array, " o"]:
    """Of usable contacts those that oppose each other, if that is looked at; however it lies.

    And of these those that the fingers meet, if there are any.
    """
    if not np.isfinite(plan.must_hold):
        return usable
    opposed = usable & opposing(plan.must_hold, options.position, options.normal)
    found = opposed & met(shape, options.position, options.normal)
    return jnp.where(jnp.any(found), found, opposed)


def held_easily(
    plan: PlanConfig, options: TargetOptions, usable: Bool[Array, " o"], around: Surroundings
) -> Bool[Array, " o"]:
    """Which contacts hold the object easily, of those that can be used: see `PlanConfig.easily`.

    Args:
        plan: The search's settings.
        options: Contacts, object frame.
        usable: Which can be used where the object lies.
        around: The object.
    """
    opposed = _gripping(plan, options, usable, around.shape)
    at = around.p_wo + options.position @ around.R_wo.T
    return opposed & light_enough(plan, plan.easily, opposed, at, around)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Planner:
    """Looks for ways that a reaching controller can go; static under jit."""

    reacher: Reacher
    config: PlanConfig

    @full_precision
    def search(
        self,
        library: Library,
        candidates: Candidates,
        around: Surroundings,
        q: Float[Array, " joints"],
        key: Array,
        failures: Int[Array, ""] | int = 0,
    ) -> Search:
        """Looks for a candidate and a posture to reach it, near the present configuration.

        Args:
            library: From :func:`start_library`.
            candidates: Of the object.
            around: Object and obstacles.
            q: Present configuration, [rad].
            key: Chooses among the library's entries around the object.
            failures: Of tries before, where the configuration looks for `at_least`: after one the
                search begins with contacts that hold the object easily, after more with its last
                lesser score.
        """
        plan, enough = self.config, self.reacher.selection.min_score
        light = np.isfinite(plan.heavier)
        if not (light or plan.at_least or plan.lesser_scores):
            return self._search(library, candidates, jnp.asarray(False), None, around, q, key)
        # Of the best, and of the last where there is a wish, the light ones come first.
        twice = (True, False) if light else (False,)
        tries = [_Try(enough, only) for only in twice]
        tries += [_Try(least) for least in plan.lesser_scores]
        begin, easy, far = jnp.int32(0), candidates.valid, None
        if plan.at_least:
            near, held, easy, share = self._wish(candidates, around)
            # A grasp that has failed near the wish fails there again more often than farther away.
            far = plan.far_weight * share * 0.5**failures if plan.far_weight else None
            wider: list[Array | float] = [*near[1:], *plan.lesser_scores]
            tries = [_Try(near[0], only) for only in twice]
            tries += [_Try(held, easy=True)] if np.isfinite(plan.easily) else []
            tries += [_Try(least) for least in wider[:-1]]
            tries += [_Try(least, only) for least in wider[-1:] for only in twice]
            begins = jnp.array([0, len(twice), len(tries) - len(twice)])
            begin = jnp.minimum(begins[jnp.minimum(failures, 2)], len(tries) - 1)
        least = jnp.stack([jnp.asarray(one.least) for one in tries])
        only_light = jnp.array([one.light for one in tries])
        only_easy = jnp.array([one.easy for one in tries])

        @jax.jit  # traced once: for its shapes and for the loop
        def among(k: Int[Array, ""]) -> Search:
            counts = candidates.valid & (candidates.score >= least[k]) & (easy | ~only_easy[k])
            score = jnp.where(counts, jnp.maximum(candidates.score, enough), 0.0)
            counted = candidates._replace(score=score)
            return self._search(library, counted, only_light[k], far, around, q, key)

        def in_vain(tried: tuple[Int[Array, ""], Search]) -> Bool[Array, ""]:
            return (tried[0] < len(tries)) & (tried[1].cost[0] >= plan.lesser_cost)

        def again(tried: tuple[Int[Array, ""], Search]) -> tuple[Int[Array, ""], Search]:
            found = among(tried[0])
            better = found.cost[0] < tried[1].cost[0]
            best = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, tried[1])
            return tried[0] + 1, best

        shapes = jax.eval_shape(among, begin)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        nothing = nothing._replace(cost=jnp.full_like(nothing.cost, jnp.inf))
        return jax.lax.while_loop(in_vain, again, (begin, nothing))[1]

    def _wish(self, candidates: Candidates, around: Surroundings) -> _Wish:
        """Among which candidates to look where the object lies, and how each compares with them."""
        plan, targets = self.config, self.reacher.selection.targets
        options = target_options(candidates, targets)
        high = admissible(candidates, options, around.p_wo, around.R_wo, targets)
        high &= candidates.valid[options.candidate]
        score = candidates.score

        def some(counted: Bool[Array, " o"]) -> Bool[Array, " v"]:
            return jnp.zeros(len(score), bool).at[options.candidate].max(counted)

        def scores(usable: Bool[Array, " v"], numbers: tuple[int, ...]) -> list[Float[Array, ""]]:
            ranked = jnp.sort(jnp.where(usable, score, 0.0))[::-1]
            last = jnp.maximum(jnp.sum(ranked > 0) - 1, 0)
            enough = self.reacher.selection.min_score
            return [jnp.minimum(enough, ranked[jnp.minimum(n - 1, last)]) for n in numbers]

        usable, easy = some(high), some(held_easily(plan, options, high, around))
        higher = jnp.searchsorted(jnp.sort(jnp.where(usable, -score, jnp.inf)), -score)
        return _Wish(
            near=scores(usable, plan.at_least),
            held=scores(easy, plan.at_least[:1])[0],
            easy=easy,
            far=higher / jnp.maximum(jnp.sum(usable), 1),
        )

    def _search(
        self,
        library: Library,
        candidates: Candidates,
        light: Bool[Array, ""],
        far: Float[Array, " v"] | None,
        around: Surroundings,
        q: Float[Array, " joints"],
        key: Array,
    ) -> Search:
        """The same among the candidates of the selection's least score, or the light of them.

        Args:
            library: From :func:`start_library`.
            candidates: Of the object.
            light: Whether among those that hold it with little force alone.
            far: What each of them costs in addition [s].
            around: Object and obstacles.
            q: Present configuration, [rad].
            key: See `search`.
        """
        plan, body = self.config, self.reacher.body
        ways = _ways(candidates, around, self.reacher.selection)
        goals, allowed = ways.options
        at = around.p_wo + ways.targets.position @ around.R_wo.T
        allowed = _gripping(plan, ways.targets, allowed, around.shape)
        allowed &= light_enough(plan, plan.heavier, allowed, at, around) | ~light
        options = Options(goals, allowed)
        starts = choose_starts(body, library, plan.starts, options, around, q, key)
        option, home = starts.option, jnp.asarray(body.home)

        def wanted(option: Int[Array, " n"]) -> TipGoals:
            return jax.tree.map(lambda leaf: leaf[option], goals)

        start = starts.q
        if plan.finalists is not None and plan.finalists < plan.starts.count:

            def begin(wanted: TipGoals, start: Float[Array, " joints"]) -> IkSolution:
                ik = replace(plan.ik, iterations=plan.first_steps)
                return solve_ik(body, ik, self._clearances, wanted, around, start, home)

            begun = jax.vmap(begin)(wanted(option), start)
            cost = attempt_costs(body, plan, allowed[option], begun, q)
            _, best = jax.lax.top_k(-cost, plan.finalists)
            option, start = option[best], begun.q[best]
        solve = jax.vmap(self._solved, in_axes=(0, 0, None))
        found, guides = solve(wanted(option), start, around)
        position = at[option]
        normal = ways.targets.normal[option] @ around.R_wo.T
        cost = attempt_costs(body, plan, allowed[option], found, q)
        asked = asked_of(plan, position, normal, around)
        cost = cost + closing_costs(body, plan, found.q, position, normal, asked, around)
        cost = cost + slip_costs(plan, position, normal, asked, around)
        if far is not None:
            cost = cost + far[jnp.asarray(ways.targets.candidate)[option]]

        if plan.way_samples:
            cost = cost + jax.vmap(lambda guide: self._way_cost(guide, q, around))(guides)
        kept = self._different(found.q, cost)
        guides = jax.tree.map(lambda leaf: leaf[kept], guides)
        pick = option[kept]
        plans = Plans(
            candidate=jnp.asarray(ways.targets.candidate, jnp.int32)[pick],
            reach=jax.nn.one_hot(jnp.asarray(ways.targets.axis)[pick], 3),
            spread=ways.targets.spread[pick],
            guide=guides._replace(known=cost[kept] < FAILED),
        )
        error = jnp.max(found.error, axis=1)
        clear = allowed[option] & (found.penetration <= 0)
        return Search(
            plans=plans,
            cost=cost[kept],
            least_error=jnp.min(jnp.where(clear, error, jnp.inf)),
            at_limit=found.at_limit[kept[0]],
        )

    @property
    def _clearances(self) -> ClearanceConfig:
        """Those that the controller keeps: where it can come to rest."""
        limits = self.reacher.config.limits
        return limits.clearances.wider(limits.margin)

    def _solved(
        self, wanted: TipGoals, start: Float[Array, " joints"], around: Surroundings
    ) -> tuple[IkSolution, Guide]:
        """A posture for goals of the tips, and the funnel into it.

        The solver, most of what there is to compile, is compiled once for both of its postures.
        """
        body, plan = self.reacher.body, self.config

        def solve(sought: _Sought, steps: Int[Array, ""]) -> tuple[_Sought, IkSolution]:
            found = solve_ik(
                body, plan.ik, self._clearances, sought.goals, around, *sought.near, steps
            )
            retreated = self._retreated(sought.goals, found.q, around)
            return _Sought(retreated, (found.q, found.q)), found

        steps = plan.ik.iterations, plan.retreat_steps or plan.ik.iterations
        first = _Sought(wanted, (start, jnp.asarray(body.home)))
        _, found = jax.lax.scan(solve, first, jnp.array(steps))
        end = jax.tree.map(lambda leaf: leaf[0], found)
        return end, self._guide(found.q, around)

    def _retreated(
        self, wanted: TipGoals, q: Float[Array, " joints"], around: Surroundings
    ) -> TipGoals:
        """Out along the normal of the plane of grasp axis and wraps.

        Or straight up, where that way leads the tips too near to the object: see `freer`.
        """
        goals, motion = wanted.tips, self.reacher.body.kinematics.motion(q)
        middle = midpoint(goals)
        axis = 0.5 * (goals[1] + goals[2]) - goals[0]
        normal = unit(jnp.cross(axis, goals[1] - goals[2]))
        # The palm's frame is at its root; the hand's extent is between it and the tips.
        outwards = motion.pos[PALM] - middle
        retreat = jnp.where(dot(outwards, normal) < 0, -normal, normal)
        length = self.reacher.config.guide.length
        if self.config.way_out > 0:
            retreat = freer(retreat, goals, length, around, self.config.way_out)
        return TipGoals(goals + length * retreat, wanted.pads)

    def _guide(self, q: Float[Array, "2 joints"], around: Surroundings) -> Guide:
        """The funnel into a posture from the retreated one."""
        motion = jax.vmap(self.reacher.body.kinematics.motion)(q)
        R, pos = around.R_wo, motion.pos[:, PALM]
        tips = jax.vmap(midpoint)(motion.pos[:, :FINGERS])
        return Guide(
            known=jnp.asarray(True),
            q=q,
            palm_pos=(pos - around.p_wo) @ R,
            palm_mat=R.T @ motion.mat[:, PALM],
            tip_shift=R.T @ (tips[1] - tips[0]),
        )

    def _way_cost(
        self, guide: Guide, q: Float[Array, " joints"], around: Surroundings
    ) -> Float[Array, ""]:
        """What a plan costs beyond the straight way to its end: detour, things in the way [s]."""
        body, plan = self.reacher.body, self.config
        inside, outside = guide.q

        def time(a: Float[Array, " joints"], b: Float[Array, " joints"]) -> Float[Array, ""]:
            return jnp.max(jnp.abs(a - b) / body.velocity_limit)

        share = jnp.arange(1, plan.way_samples + 1)[:, None] / plan.way_samples
        there = q + share * (outside - q)
        # The end of the way in is a solution.
        inwards = outside + (share - 0.5 / plan.way_samples) * (inside - outside)

        def missing(q: Float[Array, " joints"]) -> Float[Array, ""]:
            motion = body.kinematics.motion(q)
            near, safe = proximities(body, motion, around, self._clearances)
            return jnp.max(safe - stacked(list(near.values())).distance, initial=0.0)

        lacking = jax.vmap(missing)(jnp.concatenate([there, inwards]))
        short = jnp.maximum(self.reacher.config.guide.length - norm(guide.tip_shift), 0.0)
        detour = time(q, outside) + time(outside, inside) - time(q, inside)
        worst = jnp.max(lacking[: plan.way_samples]) + jnp.max(lacking[plan.way_samples :])
        return plan.haste * detour + plan.way_weight * (worst + short)

    def _different(self, q: Float[Array, "n joints"], cost: Float[Array, " n"]) -> Int[Array, " p"]:
        """The cheapest attempts of which no two put the palm in the same place."""

        def palm(q: Float[Array, " joints"]) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
            motion = self.reacher.body.kinematics.motion(q)
            return motion.pos[PALM], motion.mat[PALM]

        plan, (pos, mat) = self.config, jax.vmap(palm)(q)
        kept = []
        for _ in range(plan.kept):
            best = jnp.argmin(cost)
            kept.append(best)
            turn = norm(so3.log(jnp.einsum("nij,kj->nik", mat, mat[best])))
            near = norm(pos - pos[best]) + plan.lever * turn < plan.differs
            # Those in the same place come after all others.
            cost = jnp.where(near, cost + FAILED, cost)
        return jnp.stack(kept)
