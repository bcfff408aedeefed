"""The reaching controller: selection, command, fine-adjustment timer, handoff (method §3).

A pure function of one robot's state; thousands of them are a ``vmap``. The pose of the object is
an input of every tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.linear import full_precision
from mjx_grasp.geometry.signed_distance import Shape
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.select import HandPose, SelectionState, select, start_selection
from mjx_grasp.grasp.targets import standoffs
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import Goals, Memory, Report, command, start_memory
from mjx_grasp.reaching.config import HandoffGate, ReachConfig
from mjx_grasp.reaching.fields import pad_goals
from mjx_grasp.reaching.guide import Tracked, follow, no_guide, track
from mjx_grasp.reaching.state import Aim, Plans, ReachOutcome, ReachState, ReachTick
from mjx_grasp.robot.kinematics import Motion

# A candidate that a plan has chosen is preferred to all others by this, [m].
_CHOSEN = 10.0
# After a re-selection thumb contacts this near to the abandoned one are ruled out, [m].
_RULED_OUT = 0.02
# An object that moves less in a tick, in [m] and [rad] together, is still; so is an obstacle.
_STILL = 1e-4
# An obstacle within so many clearances holds the hand off.
_HOLDS = 2.0


class _Progress(NamedTuple):
    """What a tick tells about how the reach goes on."""

    error: Float[Array, ""]
    """largest tip error, +inf without targets [m]"""
    to_go: Float[Array, ""]
    """of the joints to the guide, at full speed [s]"""
    ready: Bool[Array, ""]
    """whether the gate is open"""
    timer: Float[Array, ""]
    """the fine-adjustment timer [s]"""
    near: Float[Array, ""]
    """see `ReachState` [s]"""
    waits: Bool[Array, ""]
    """whether something moves that is waited for"""


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
            near=jnp.float32(0.0),
            clock=jnp.float32(0.0),
            tries=jnp.int32(0),
            best=jnp.full(2, jnp.inf, jnp.float32),
            since=jnp.float32(0.0),
            stale=jnp.asarray(False),
            planned_p=p_wo,
            planned_R=R_wo,
            p_wo=p_wo,
            R_wo=R_wo,
            obstacles=jnp.full((obstacles, 4), jnp.nan, jnp.float32),
            outcome=jnp.int32(ReachOutcome.RUNNING),
            infeasible=jnp.int32(0),
        )
        return state if plans is None else self._take(state, plans, state.plan)

    def adopt(
        self, state: ReachState, plans: Plans, p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"]
    ) -> ReachState:
        """Goes on with new plans; all tries are open again.

        Args:
            state: Of the last tick.
            plans: To follow.
            p_wo: Object origin in world that they were made for, [m].
            R_wo: Object rotation that they were made for.
        """
        state = state._replace(
            planned_p=p_wo,
            planned_R=R_wo,
            stale=jnp.asarray(False),
            tries=jnp.int32(0),
            best=jnp.full(2, jnp.inf, jnp.float32),
            since=jnp.float32(0.0),
        )
        return self._take(state, plans, jnp.int32(0))

    def hand(self, motion: Motion) -> HandPose:
        """The hand as the selection sees it."""
        palm = motion.mat[PALM]
        body = self.body
        return HandPose(motion.pos[:FINGERS], palm @ body.approach_axis, palm @ body.opposing_axis)

    @full_precision
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
        twist: Float[Array, " 6"] | None = None,
    ) -> tuple[ReachState, ReachTick]:
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
            twist: The object's, where it is better known than from its last two poses: velocity of
                its origin and angular velocity, world, [m/s] and [rad/s].
        """
        aim = self.aim(state, q, shape, candidates, p_wo, R_wo, obstacles, plans, twist)
        done = command(self.body, self.config, q, aim.goals, aim.around, state.memory)
        return self._after(state, q, aim, done, candidates, plans)

    @full_precision
    def aim(
        self,
        state: ReachState,
        q: Float[Array, " joints"],
        shape: Shape,
        candidates: Candidates,
        p_wo: Float[Array, " 3"],
        R_wo: Float[Array, "3 3"],
        obstacles: Float[Array, "k 4"],
        plans: Plans | None = None,
        twist: Float[Array, " 6"] | None = None,
    ) -> Aim:
        """What :meth:`tick` goes for, of the same arguments."""
        dt, most = self.config.controller.dt, self.config.limits.object_speed
        motion = self.body.kinematics.motion(q)
        twist = _twist(state, p_wo, R_wo, dt) if twist is None else twist
        moves = (norm(twist[:3]) + norm(twist[3:])) * dt > _STILL
        drift = _velocity(state.obstacles, obstacles, dt, most)
        around = Surroundings(shape, p_wo, R_wo, _likely(twist, most), obstacles, drift)
        if plans is not None:
            candidates = self._with_planned(candidates, plans, state.plan)
        targets, selection = select(
            candidates, state.selection, self.hand(motion), p_wo, R_wo, self.selection
        )
        tips = standoffs(targets.position, targets.normal, self.selection.targets)
        guide, tracked = no_guide(len(q)), Tracked(state.guide_q, jnp.float32(0.0))
        if plans is not None and self.config.guide.enabled:
            guide = jax.tree.map(lambda leaf: leaf[state.plan], plans.guide)
            tracked = track(self.body, guide, state.guide_q, p_wo, R_wo, self.config.guide)
        wanted, left = follow(guide, tracked, state.left, motion, around, self.config.guide, dt)
        goals = Goals(tips, pad_goals(tips), wanted)
        return Aim(motion, around, moves, targets, selection, goals, tracked.q, left)

    def _after(
        self,
        state: ReachState,
        q: Float[Array, " joints"],
        aim: Aim,
        done: tuple[Float[Array, " joints"], Memory, Report],
        candidates: Candidates,
        plans: Plans | None,
    ) -> tuple[ReachState, ReachTick]:
        """The state after a command, and what the tick did."""
        config, limits = self.config.controller, self.config.limits
        velocity, memory, report = done
        around, targets, guide = aim.around, aim.targets, aim.goals.guide
        running = state.outcome == ReachOutcome.RUNNING
        velocity = jnp.where(running & targets.valid, velocity, 0.0)
        moves = aim.moves
        state = state._replace(
            selection=aim.selection,
            memory=memory._replace(command=velocity),
            guide_q=aim.guide_q,
            left=aim.left,
            p_wo=around.p_wo,
            R_wo=around.R_wo,
            obstacles=around.obstacles,
            infeasible=state.infeasible + (running & ~report.feasible),
        )
        error = jnp.where(targets.valid, jnp.max(report.error), jnp.inf)
        to_go = jnp.max(jnp.abs(aim.guide_q[0] - q) / self.body.velocity_limit)
        # What passes is waited for: another plan may be a long way round.
        passes = jnp.any(norm(around.obstacle_velocity) * config.dt > _STILL)
        passes &= report.obstacle_distance < _HOLDS * limits.clearances.obstacles
        timer = jnp.where(error < config.fine_distance, state.timer + config.dt, 0.0)
        rests = (error <= config.gate.near_tips) & ~(moves | passes)
        near = jnp.where(rests, state.near + config.dt, 0.0)
        progress = _Progress(
            error=error,
            to_go=jnp.where(guide.known & (guide.astray < 0.5), to_go, jnp.inf),
            ready=targets.valid
            & is_ready(config.gate, timer, near, error, report.midpoint, jnp.max(report.speed)),
            timer=timer,
            near=near,
            waits=moves | passes,
        )
        state = self._advance(state, progress, targets.valid, candidates, plans)
        if plans is not None:
            number = plans.candidate.shape[0]
            stale = self._stale(state, guide.astray, moves, number)
            state = state._replace(stale=state.stale | stale)
        tips = aim.motion.pos[:FINGERS]
        return state, ReachTick(velocity, targets, aim.goals.tips, tips, progress.ready, report)

    def _advance(
        self,
        state: ReachState,
        now: _Progress,
        valid: Bool[Array, ""],
        candidates: Candidates,
        plans: Plans | None,
    ) -> ReachState:
        """Timer, handoff, re-selection, failure."""
        config = self.config.controller
        running = state.outcome == ReachOutcome.RUNNING
        clock = state.clock + config.dt
        timed_out = now.timer >= config.fine_timeout

        # Ahead on the guide's way or nearer with the tips: either is progress.
        to_go = jnp.stack([now.to_go, now.error / self.config.fields.speed])
        improves = to_go < state.best - config.stall_progress
        # Once arrived, or while something else moves, the way to go is counted afresh.
        afresh = (now.error < config.stall_error) | now.waits
        best = jnp.where(afresh, jnp.inf, jnp.where(improves, to_go, state.best))
        since = jnp.where(jnp.any(improves) | afresh, 0.0, state.since + config.dt)
        stalls = since >= config.stall_time
        as_near_as_it_gets = stalls & (now.error <= config.gate.stalled_tips)
        hands_off = (now.ready | as_near_as_it_gets) & config.hands_off
        again = jnp.where(timed_out, config.reselect_late, stalls)
        again &= running & ~hands_off & (state.tries < config.reselections)
        late = clock >= config.timeout
        fails = ~hands_off & ~again & (late | timed_out)
        failure = jnp.where(valid, ReachOutcome.FAILED, ReachOutcome.NO_CANDIDATE)
        ends = jnp.where(fails, failure, ReachOutcome.RUNNING)
        outcome = jnp.where(hands_off, ReachOutcome.HANDOFF, ends)
        state = state._replace(
            timer=jnp.where(again & timed_out, 0.0, now.timer),
            near=now.near,
            clock=clock,
            best=jnp.where(again, jnp.inf, best),
            since=jnp.where(again, 0.0, since),
            tries=state.tries + again,
            outcome=jnp.where(running, outcome, state.outcome).astype(jnp.int32),
        )
        if plans is not None:
            number = plans.candidate.shape[0]
            other = self._take(state, plans, (state.plan + 1) % number)
        else:
            other = state._replace(selection=_without(state.selection, candidates))
        return jax.tree.map(lambda a, b: jnp.where(again, a, b), other, state)

    def _stale(
        self, state: ReachState, astray: Float[Array, ""], moves: Bool[Array, ""], number: int
    ) -> Bool[Array, ""]:
        """Whether the object is elsewhere than planned for, or all plans were tried in vain."""
        config, lever = self.config.controller, self.config.guide.lever
        turn = norm(so3.log(state.R_wo @ state.planned_R.T))
        elsewhere = norm(state.p_wo - state.planned_p) + lever * turn > config.replan_moved
        # While it moves, the present plan's configurations follow it as far as they can.
        elsewhere &= ~moves | (astray > 0.5)
        in_vain = (state.tries >= number) & np.isfinite(config.replan_moved)
        return (state.outcome == ReachOutcome.RUNNING) & (elsewhere | in_vain)

    def _with_planned(
        self, candidates: Candidates, plans: Plans, number: Int[Array, ""]
    ) -> Candidates:
        """A planned candidate has enough score; a plan may go on to lesser ones."""
        planned = jnp.arange(len(candidates.score)) == plans.candidate[number]
        planned &= candidates.valid & plans.guide.known[number]
        enough = jnp.maximum(candidates.score, self.selection.min_score)
        return candidates._replace(score=jnp.where(planned, enough, candidates.score))

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


def is_ready(
    gate: HandoffGate,
    timer: Float[Array, ""],
    near: Float[Array, ""],
    error: Float[Array, ""],
    midpoint: Float[Array, ""],
    speed: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether the hand is near enough for the closing policy.

    Args:
        gate: What counts as near enough.
        timer: The fine-adjustment timer, [s].
        near: Time for which it has been within `near_tips` while nothing moves, [s].
        error: Largest tip error, [m].
        midpoint: Error of the midpoint, [m].
        speed: Of the fastest tip, [m/s].
    """
    arrived = (midpoint < gate.midpoint) & (error <= gate.tips) & (speed <= gate.tip_speed)
    late = (timer >= gate.late) & (error <= gate.late_tips)
    return arrived | (near >= gate.near) | late


def _twist(
    state: ReachState, p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"], dt: float
) -> Float[Array, " 6"]:
    """The object's twist from its last two poses, [m/s] and [rad/s]."""
    return jnp.concatenate([p_wo - state.p_wo, so3.log(R_wo @ state.R_wo.T)]) / dt


def _likely(twist: Float[Array, " 6"], most: float) -> Float[Array, " 6"]:
    """A twist, or none in a jump."""
    jumps = (norm(twist[:3]) > most) | (norm(twist[3:]) > 10.0 * most)
    return jnp.where(jumps, 0.0, twist)


def _velocity(
    before: Float[Array, "k 4"], now: Float[Array, "k 4"], dt: float, most: float
) -> Float[Array, "k 3"]:
    """Velocities of the obstacles' centres, [m/s]; none at first, and none in a jump."""
    velocity = (now[:, :3] - before[:, :3]) / dt
    known = norm(velocity) <= most  # false for NaN
    return jnp.where(known[:, None], velocity, 0.0)


def _without(selection: SelectionState, candidates: Candidates) -> SelectionState:
    """The running candidate and its neighbours are ruled out."""
    thumb = candidates.thumb[jnp.maximum(selection.candidate, 0)]
    out = norm(candidates.thumb - thumb) < _RULED_OUT
    return selection._replace(bias=jnp.where(out, jnp.inf, selection.bias))
