"""The reaching controller: selection, command, fine-adjustment timer, handoff (method §3).

A pure function of one robot's state; thousands of them are a ``vmap``. The pose of the object is
an input of every tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Shape
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.select import Hand, SelectionState, select, start_selection
from mjx_grasp.grasp.targets import Targets, standoffs
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import Goals, Memory, Report, command, start_memory
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.fields import pad_goals
from mjx_grasp.reaching.guide import Guide, follow, no_guide, track
from mjx_grasp.robot.kinematics import Motion

# A candidate that a plan has chosen is preferred to all others by this, [m].
_CHOSEN = 10.0
# After a re-selection thumb contacts this near to the abandoned one are ruled out, [m].
_RULED_OUT = 0.02
# An object that moves less in a tick, in [m] and [rad] together, is still; so is an obstacle.
_STILL = 1e-4
# An obstacle within so many clearances holds the hand off.
_HOLDS = 2.0


class Outcome(IntEnum):
    """How a reach stands."""

    RUNNING = 0
    HANDOFF = 1
    """near enough for the closing policy"""
    FAILED = 2
    """out of time and re-selections"""
    NO_CANDIDATE = 3
    """out of time without an admissible candidate"""


class Plans(NamedTuple):
    """Ways to reach an object, the best first; ``[p, …]``.

    Attributes:
        candidate: ``[p]`` of each.
        reach: ``[p, 3]`` preference of the object axes as reach direction.
        spread: ``[p, 3]`` direction of the wraps, object frame.
        guide: Each a :class:`Guide`.
    """

    candidate: Int[Array, " p"]
    reach: Float[Array, "p 3"]
    spread: Float[Array, "p 3"]
    guide: Guide


class ReachState(NamedTuple):
    """What the controller remembers.

    Attributes:
        selection: Of the candidates.
        memory: Of the command.
        plan: Number of the plan that is followed; 0 also without plans.
        guide_q: ``[2, joints]`` the plan's configurations as they follow the object, [rad].
        left: Share of the retreat that is left.
        timer: The fine-adjustment timer, [s].
        clock: Since the start, [s].
        tries: Re-selections made.
        best: ``[2]`` least time to go so far, of joints to the guide and of tips to targets, [s].
        since: Time since it was improved, [s].
        stale: Whether the plans no longer fit, and new ones are due.
        planned_p, planned_R: Object pose that they were made for.
        p_wo, R_wo: Object pose at the last tick.
        obstacles: ``[k, 4]`` at the last tick; NaN before the first.
        outcome: An :class:`Outcome`.
        infeasible: Ticks whose programme had no solution.
    """

    selection: SelectionState
    memory: Memory
    plan: Int[Array, ""]
    guide_q: Float[Array, "2 joints"]
    left: Float[Array, ""]
    timer: Float[Array, ""]
    clock: Float[Array, ""]
    tries: Int[Array, ""]
    best: Float[Array, " 2"]
    since: Float[Array, ""]
    stale: Bool[Array, ""]
    planned_p: Float[Array, " 3"]
    planned_R: Float[Array, "3 3"]
    p_wo: Float[Array, " 3"]
    R_wo: Float[Array, "3 3"]
    obstacles: Float[Array, "k 4"]
    outcome: Int[Array, ""]
    infeasible: Int[Array, ""]


class Tick(NamedTuple):
    """What one tick did.

    Attributes:
        velocity: ``[joints]`` the command, [rad/s].
        targets: The three-point interface.
        goals: ``[3, 3]`` standoff targets, world, [m].
        tips: ``[3, 3]`` tip frames, world, [m].
        report: Errors, distances, feasibility.
    """

    velocity: Float[Array, " joints"]
    targets: Targets
    goals: Float[Array, "3 3"]
    tips: Float[Array, "3 3"]
    report: Report


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Reacher:
    """Controller of one robot with one set of settings; static under jit."""

    body: Body
    config: ReachConfig
    selection: SelectionConfig

    def start(
        self,
        q: Float[Array, " joints"],
        candidates: Candidates,
        p_wo: Float[Array, " 3"],
        R_wo: Float[Array, "3 3"],
        plans: Plans | None = None,
        obstacles: int = 0,
    ) -> ReachState:
        """The state at the start of a reach.

        Args:
            q: Configuration, [rad].
            candidates: Of the object.
            p_wo: Object origin in world, [m].
            R_wo: Object rotation.
            plans: Ways to reach it; none in the paper's controller.
            obstacles: How many spheres there will be to avoid.
        """
        hand = self.hand(self.body.kinematics.motion(q))
        state = ReachState(
            selection=start_selection(candidates, hand, R_wo),
            memory=start_memory(self.body, obstacles),
            plan=jnp.int32(0),
            guide_q=jnp.zeros((2, len(q))),
            left=jnp.float32(1.0),
            timer=jnp.float32(0.0),
            clock=jnp.float32(0.0),
            tries=jnp.int32(0),
            best=jnp.full(2, jnp.inf),
            since=jnp.float32(0.0),
            stale=jnp.asarray(False),
            planned_p=p_wo,
            planned_R=R_wo,
            p_wo=p_wo,
            R_wo=R_wo,
            obstacles=jnp.full((obstacles, 4), jnp.nan),
            outcome=jnp.int32(Outcome.RUNNING),
            infeasible=jnp.int32(0),
        )
        return state if plans is None else self._take(state, plans, state.plan)

    def adopt(self, state: ReachState, plans: Plans) -> ReachState:
        """Goes on with new plans for the object's present pose; all tries are open again."""
        state = state._replace(
            planned_p=state.p_wo,
            planned_R=state.R_wo,
            stale=jnp.asarray(False),
            tries=jnp.int32(0),
            best=jnp.full(2, jnp.inf),
            since=jnp.float32(0.0),
        )
        return self._take(state, plans, jnp.int32(0))

    def hand(self, motion: Motion) -> Hand:
        """The hand as the selection sees it."""
        palm = motion.mat[PALM]
        body = self.body
        return Hand(motion.pos[:FINGERS], palm @ body.approach_axis, palm @ body.opposing_axis)

    def tick(
        self,
        state: ReachState,
        q: Float[Array, " joints"],
        shape: Shape,
        candidates: Candidates,
        p_wo: Float[Array, " 3"],
        R_wo: Float[Array, "3 3"],
        obstacles: Float[Array, "k 4"],
        plans: Plans | None = None,
    ) -> tuple[ReachState, Tick]:
        """One control period; the command is zero once the reach has ended.

        Args:
            state: From :meth:`start` or the last tick.
            q: Configuration, [rad].
            shape: The object.
            candidates: Of the object.
            p_wo: Object origin in world now, [m].
            R_wo: Object rotation now.
            obstacles: Spheres to avoid: centre in world and radius, [m].
            plans: As at the start.
        """
        # No accelerator shall round products of small matrices to TF32.
        with jax.default_matmul_precision("highest"):
            return self._tick(state, q, shape, candidates, p_wo, R_wo, obstacles, plans)

    def _tick(self, state, q, shape, candidates, p_wo, R_wo, obstacles, plans):
        config, limits = self.config.controller, self.config.limits
        motion = self.body.kinematics.motion(q)
        twist = _twist(state, p_wo, R_wo, config.dt, limits.object_speed)
        drift = _velocity(state.obstacles, obstacles, config.dt, limits.object_speed)
        around = Surroundings(shape, p_wo, R_wo, twist, obstacles, drift)
        targets, selection = select(
            candidates, state.selection, self.hand(motion), p_wo, R_wo, self.selection
        )
        goals = standoffs(targets.position, targets.normal, self.selection.targets)
        guide, guide_q, astray = no_guide(len(q)), state.guide_q, jnp.float32(0.0)
        if plans is not None and self.config.guide.enabled:
            guide = jax.tree.map(lambda leaf: leaf[state.plan], plans.guide)
            guide_q, astray = track(self.body, guide, guide_q, p_wo, R_wo, self.config.guide)
        wanted, left = follow(
            guide, guide_q, astray, state.left, motion, p_wo, R_wo, self.config.guide, config.dt
        )
        velocity, memory, report = command(
            self.body,
            self.config,
            q,
            Goals(goals, pad_goals(goals), wanted),
            around,
            state.memory,
        )
        running = state.outcome == Outcome.RUNNING
        velocity = jnp.where(running & targets.valid, velocity, 0.0)
        memory = memory._replace(command=velocity)
        moves = norm(p_wo - state.p_wo) + norm(so3.log(R_wo @ state.R_wo.T)) > _STILL
        state = state._replace(
            selection=selection,
            memory=memory,
            guide_q=guide_q,
            left=left,
            p_wo=p_wo,
            R_wo=R_wo,
            obstacles=obstacles,
            infeasible=state.infeasible + (running & ~report.feasible),
        )
        error = jnp.where(targets.valid, jnp.max(report.error), jnp.inf)
        to_go = jnp.max(jnp.abs(guide_q[0] - q) / self.body.velocity_limit)
        to_go = jnp.where(guide.known & (wanted.astray < 0.5), to_go, jnp.inf)
        # What passes is waited for: another plan may be a long way round.
        passes = jnp.any(norm(drift) * config.dt > _STILL)
        passes &= report.obstacle_distance < _HOLDS * limits.clearances.obstacles
        state = self._advance(
            state, targets, candidates, error, report.midpoint, to_go, moves | passes, plans
        )
        if plans is not None:
            number = plans.candidate.shape[0]
            state = state._replace(stale=self._stale(state, wanted.astray, moves, number))
        return state, Tick(velocity, targets, goals, motion.pos[:FINGERS], report)

    def _advance(self, state, targets, candidates, error, midpoint_error, to_go, waits, plans):
        """Timer, handoff, re-selection, failure."""
        config = self.config.controller
        running = state.outcome == Outcome.RUNNING
        timer = jnp.where(error < config.fine_distance, state.timer + config.dt, 0.0)
        clock = state.clock + config.dt
        timed_out = timer >= config.fine_timeout
        arrived = targets.valid & (midpoint_error < config.handoff_midpoint)
        arrived &= error <= config.handoff_tips
        near = error <= config.handoff_largest
        hands_off = arrived | (timed_out & near)

        # Ahead on the guide's way or nearer with the tips: either is progress.
        now = jnp.stack([to_go, error / self.config.fields.speed])
        improves = now < state.best - config.stall_progress
        # Once arrived, or while something else moves, the way to go is counted afresh.
        afresh = (error < config.stall_error) | waits
        best = jnp.where(afresh, jnp.inf, jnp.where(improves, now, state.best))
        since = jnp.where(jnp.any(improves) | afresh, 0.0, state.since + config.dt)
        stalls = since >= config.stall_time
        again = jnp.where(timed_out, config.reselect_late, stalls)
        again &= running & ~hands_off & (state.tries < config.reselections)
        late = clock >= config.timeout
        fails = ~hands_off & ~again & (late | timed_out)
        failure = jnp.where(targets.valid, Outcome.FAILED, Outcome.NO_CANDIDATE)
        outcome = jnp.where(hands_off, Outcome.HANDOFF, jnp.where(fails, failure, Outcome.RUNNING))
        state = state._replace(
            timer=jnp.where(again & timed_out, 0.0, timer),
            clock=clock,
            best=jnp.where(again, jnp.inf, best),
            since=jnp.where(again, 0.0, since),
            tries=state.tries + again,
            outcome=jnp.where(running, outcome, state.outcome).astype(jnp.int32),
        )
        if plans is not None:
            number = plans.candidate.shape[0]
            plan = (state.plan + 1) % number
            other = self._take(state, plans, plan)
        else:
            other = state._replace(selection=_without(state.selection, candidates))
        return jax.tree.map(lambda a, b: jnp.where(again, a, b), other, state)

    def _stale(self, state: ReachState, astray, moves, number: int) -> Bool[Array, ""]:
        """Whether the object is elsewhere than planned for, or all plans were tried in vain."""
        config, lever = self.config.controller, self.config.guide.lever
        turn = norm(so3.log(state.R_wo @ state.planned_R.T))
        elsewhere = norm(state.p_wo - state.planned_p) + lever * turn > config.replan_moved
        # While it moves, the present plan's configurations follow it as far as they can.
        elsewhere &= ~moves | (astray > 0.5)
        in_vain = (state.tries >= number) & np.isfinite(config.replan_moved)
        return (state.outcome == Outcome.RUNNING) & (elsewhere | in_vain)

    def _take(self, state: ReachState, plans: Plans, number: Int[Array, ""]) -> ReachState:
        """Follows a plan: its candidate, reach direction and order of the wraps."""
        chosen = jnp.arange(state.selection.bias.shape[0]) == plans.candidate[number]
        return state._replace(
            plan=number,
            guide_q=plans.guide.q[number],
            left=jnp.float32(1.0),
            selection=SelectionState(
                candidate=plans.candidate[number],
                spread=plans.spread[number],
                reach=plans.reach[number],
                bias=jnp.where(chosen, -_CHOSEN, 0.0),
            ),
        )


def _twist(state, p_wo, R_wo, dt, most):
    """The object's twist from its last two poses, [m/s] and [rad/s]; none in a jump."""
    linear = (p_wo - state.p_wo) / dt
    angular = so3.log(R_wo @ state.R_wo.T) / dt
    jumps = (norm(linear) > most) | (norm(angular) > 10.0 * most)
    return jnp.where(jumps, 0.0, jnp.concatenate([linear, angular]))


def _velocity(before, now, dt, most):
    """Velocities of the obstacles' centres, [m/s]; none at first, and none in a jump."""
    velocity = (now[:, :3] - before[:, :3]) / dt
    known = norm(velocity) <= most  # false for NaN
    return jnp.where(known[:, None], velocity, 0.0)


def _without(selection: SelectionState, candidates: Candidates) -> SelectionState:
    """The running candidate and its neighbours are ruled out."""
    thumb = candidates.thumb[jnp.maximum(selection.candidate, 0)]
    out = norm(candidates.thumb - thumb) < _RULED_OUT
    return selection._replace(bias=jnp.where(out, jnp.inf, selection.bias))
