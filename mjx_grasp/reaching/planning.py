"""Which candidate the arm and hand can reach, and with what posture: IK from a library of starts.

It tells the upper bound of every rate (the share of poses for which there is a solution at all),
and guides selection and reaching in the presets that look ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import dot, norm, unit
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.targets import TargetOptions, admissible, standoffs, target_options
from mjx_grasp.posture.body import FINGERS, PALM, ReachBody
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.controller import Plans, Reacher, ReachState
from mjx_grasp.reaching.fields import midpoint, pad_goals
from mjx_grasp.reaching.guide import Guide
from mjx_grasp.reaching.ik import PlanIkConfig, PlanIkSolution, solve_ik
from mjx_grasp.robot.arrays import robot_arrays
from mjx_grasp.robot.postures import draw_postures
from mjx_grasp.sim.scene import ObjectArea

# A difference of pad directions counts as much as tips this far off, [m].
_DIRECTION_SCALE = 0.03
# Cost of a metre of tip error or missing clearance, and of an attempt that is none, [s].
_LACKING, _FAILED = 1e3, 1e4


@dataclass(frozen=True)
class PlanConfig:
    """How hard a solution is looked for."""

    library: int = 60_000
    """configurations from which the starts are taken [-]"""
    near: int = 1024
    """of them, those around the object, compared with every candidate [-]"""
    starts: int = 32
    """of them, the most promising, that are solved [-]"""
    kept: int = 3
    """plans that differ, for re-selection [-]"""
    differs: float = 0.05
    """palm poses this far apart differ, a turn counting with the lever below [m]"""
    lever: float = 0.1
    """of the palm's turn against its displacement [m/rad]"""
    time_scale: float = 0.05
    """a start this much farther in time counts as much as tips this far off [m/s]"""
    tolerance: float = 0.005
    """largest tip error of a solution to be reached for [m]"""
    seed: int = 0
    """of the library"""
    area: ObjectArea = field(default_factory=ObjectArea)
    """over which the library's hands are about to grasp something"""
    ik: PlanIkConfig = field(default_factory=PlanIkConfig)


class Library(NamedTuple):
    """Configurations with the hand about to grasp something over the table.

    Attributes:
        q: ``[l, joints]`` in [rad].
        tips: ``[l, 3, 3]`` tip frames in world, [m].
        pads: ``[l, 3, 3]`` pad normals.
    """

    q: Float[Array, "l joints"]
    tips: Float[Array, "l 3 3"]
    pads: Float[Array, "l 3 3"]


class Search(NamedTuple):
    """What a search found.

    Attributes:
        plans: The best first; of those that are not ``guide.known`` no attempt succeeded.
        cost: ``[p]`` time to get there and what is lacking, [s]; the less the better.
        least_error: Over all clear solutions, the least of their largest tip errors, [m]; +inf if
            all penetrate something.
        least_penetration: Over all solutions within 20 mm, the least penetration, [m].
        at_limit: Whether the best attempt has a joint at its limit.
    """

    plans: Plans
    cost: Float[Array, " p"]
    least_error: Float[Array, ""]
    least_penetration: Float[Array, ""]
    at_limit: Bool[Array, ""]


def start_library(body: ReachBody, config: PlanConfig) -> Library:
    """Draws the library of a robot; takes some seconds.

    Raises:
        InputError: The robot does not reach the object area.
    """
    arrays = robot_arrays(body.robot)
    q = draw_postures(arrays, config.library, config.area.x, config.area.y, config.seed)

    @jax.jit
    @jax.vmap
    def tips_and_pads(q):
        motion = body.kinematics.motion(q)
        return motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]

    tips, pads = tips_and_pads(q)
    return Library(jnp.asarray(q), tips, pads)


class _Ways(NamedTuple):
    """All ways to use the candidates, with the object where it is; world frame."""

    options: TargetOptions
    goals: Float[Array, "v 3 3"]
    """standoff targets [m]"""
    pads: Float[Array, "v 3 3"]
    """unit directions for the pad normals"""
    admissible: Bool[Array, " v"]


def _ways(candidates: Candidates, around: Surroundings, selection: SelectionConfig) -> _Ways:
    config = selection.targets
    options = target_options(candidates, config)
    high = admissible(candidates, options, around.p_wo, around.R_wo, config)
    scores = (candidates.score >= selection.min_score)[options.candidate]
    local = standoffs(options.position, options.normal, config)
    goals = around.p_wo + local @ around.R_wo.T
    return _Ways(options, goals, jax.vmap(pad_goals)(goals), high & scores)


def plan_reach(
    body: ReachBody,
    config: ReachConfig,
    selection: SelectionConfig,
    plan: PlanConfig,
    library: Library,
    candidates: Candidates,
    around: Surroundings,
    q: Float[Array, " joints"],
    key: Array,
) -> Search:
    """Looks for a candidate and a posture to reach it, near the present configuration.

    Args:
        body: The robot.
        config: Settings of reaching.
        selection: Rejections of candidates.
        plan: How hard to look.
        library: From :func:`start_library`.
        candidates: Of the object.
        around: Object and obstacles.
        q: Present configuration, [rad].
        key: Chooses among the library's entries around the object.
    """
    # No accelerator shall round products of small matrices to TF32.
    with jax.default_matmul_precision("highest"):
        return _plan(body, config, selection, plan, library, candidates, around, q, key)


def plan_again(
    reacher: Reacher,
    search: Callable[..., Plans],
    state: ReachState,
    plans: Plans,
    *situation: Any,
) -> tuple[ReachState, Plans]:
    """New plans for those of a batch of reaches whose own no longer fit.

    As long as all of them fit, nothing is computed.

    Args:
        reacher: The controller.
        search: Makes the plans of one reach from its situation.
        state: Of all reaches, stacked.
        plans: That they follow.
        *situation: What ``search`` wants to know, stacked.
    """

    def renewed():
        found = jax.vmap(search)(*situation)
        adopted = jax.vmap(reacher.adopt)(state, found)

        def chosen(new, old):
            stale = state.stale.reshape(-1, *[1] * (new.ndim - 1))
            return jnp.where(stale, new, old)

        return jax.tree.map(chosen, (adopted, found), (state, plans))

    return jax.lax.cond(jnp.any(state.stale), renewed, lambda: (state, plans))


def _plan(body, config, selection, plan, library, candidates, around, q, key) -> Search:
    ways = _ways(candidates, around, selection)
    middle = 0.5 * library.tips[:, 0] + 0.25 * (library.tips[:, 1] + library.tips[:, 2])
    distance = norm(middle - around.p_wo)
    # A little chance, so that other keys find other starts.
    distance = distance + 0.02 * jax.random.uniform(key, distance.shape)
    _, near = jax.lax.top_k(-distance, plan.near)

    def features(tips, pads):
        pads = _DIRECTION_SCALE * pads
        return jnp.concatenate([tips.reshape(-1, 9), pads.reshape(-1, 9)], axis=1)

    origin = around.p_wo
    have = features(library.tips[near] - origin, library.pads[near])
    want = features(ways.goals - origin, ways.pads)
    squares = jnp.sum(want**2, axis=1)
    gap = jnp.where(ways.admissible, squares, jnp.inf) - 2.0 * have @ want.T
    option = jnp.argmin(gap, axis=1)
    gap = jnp.take_along_axis(gap, option[:, None], axis=1)[:, 0] + jnp.sum(have**2, axis=1)
    time = jnp.max(jnp.abs(library.q[near] - q) / body.velocity_limit, axis=1)
    gap = gap + (plan.time_scale * time) ** 2
    _, best = jax.lax.top_k(-gap, plan.starts)
    option, start = option[best], library.q[near[best]]

    def attempt(option, start):
        goals, pads, home = ways.goals[option], ways.pads[option], jnp.asarray(body.home)
        return solve_ik(body, config, plan.ik, goals, pads, around, start, home)

    found: PlanIkSolution = jax.vmap(attempt)(option, start)
    cost = _costs(body, plan, ways.admissible[option], found, q)
    kept = _different(body, plan, found.q, cost)

    def planned(k):
        known = cost[k] < _FAILED
        return _guide(body, config, plan, ways, option[k], found.q[k], around, known)

    pick = option[kept]
    plans = Plans(
        candidate=jnp.asarray(ways.options.candidate, jnp.int32)[pick],
        reach=jax.nn.one_hot(jnp.asarray(ways.options.axis)[pick], 3),
        spread=ways.options.spread[pick],
        guide=jax.vmap(planned)(kept),
    )
    error, allowed = jnp.max(found.error, axis=1), ways.admissible[option]
    clear, close = allowed & (found.penetration <= 0), allowed & (error <= 0.02)
    return Search(
        plans=plans,
        cost=cost[kept],
        least_error=jnp.min(jnp.where(clear, error, jnp.inf)),
        least_penetration=jnp.min(jnp.where(close, found.penetration, jnp.inf)),
        at_limit=found.at_limit[kept[0]],
    )


def _guide(body, config, plan, ways, option, q, around, known) -> Guide:
    """The funnel into a solution: out along the normal of the plane of grasp axis and wraps."""
    goals, pads = ways.goals[option], ways.pads[option]
    motion = body.kinematics.motion(q)
    middle = midpoint(goals)
    axis = 0.5 * (goals[1] + goals[2]) - goals[0]
    normal = unit(jnp.cross(axis, goals[1] - goals[2]))
    # The palm's frame is at its root; the hand's extent is between it and the tips.
    outwards = motion.pos[PALM] - middle
    retreat = jnp.where(dot(outwards, normal) < 0, -normal, normal)
    shifted = goals + config.guide.length * retreat
    retreated = solve_ik(body, config, plan.ik, shifted, pads, around, q, q)
    outside = body.kinematics.motion(retreated.q)
    R = around.R_wo
    pos = jnp.stack([motion.pos[PALM], outside.pos[PALM]])
    return Guide(
        known=known,
        q=jnp.stack([q, retreated.q]),
        palm_pos=(pos - around.p_wo) @ R,
        palm_mat=R.T @ jnp.stack([motion.mat[PALM], outside.mat[PALM]]),
        tip_shift=R.T @ (midpoint(outside.pos[:FINGERS]) - midpoint(motion.pos[:FINGERS])),
    )


def _costs(body, plan, admissible, found: PlanIkSolution, q) -> Float[Array, " n"]:
    """Of attempts: time to get there at full speed, and heavily what they lack, [s]."""
    time = jnp.max(jnp.abs(found.q - q) / body.velocity_limit, axis=1)
    error = jnp.max(found.error, axis=1)
    lacking = jnp.maximum(jnp.maximum(error - plan.tolerance, found.missing), 0.0)
    return jnp.where(admissible, time + _LACKING * lacking, _FAILED)


def _different(body, plan, q, cost) -> Int[Array, " p"]:
    """The cheapest attempts of which no two put the palm in the same place."""

    def palm(q):
        motion = body.kinematics.motion(q)
        return motion.pos[PALM], motion.mat[PALM]

    pos, mat = jax.vmap(palm)(q)
    kept = []
    for _ in range(plan.kept):
        best = jnp.argmin(cost)
        kept.append(best)
        turn = norm(so3.log(jnp.einsum("nij,kj->nik", mat, mat[best])))
        near = norm(pos - pos[best]) + plan.lever * turn < plan.differs
        # Those in the same place come after all others.
        cost = jnp.where(near, cost + _FAILED, cost)
    return jnp.stack(kept)
