"""The controller of a whole grasp: select, reach, close, lift, hold; one tick over a phase.

It composes the `Reacher` (method §3) and the `Closer` (method §5), and knows what a robot knows:
its own measurements, the tracked pose of the object, and touch flags if there are any. Contacts are
kept in the object frame and follow the tracked pose.

A tick is pure. Looking for plans is an event of its own: `Grasper.tick` says when new ones are due,
and whoever runs the loop calls `Grasper.plan` and `Grasper.adopt`, beside the loop if that takes
longer than a control period. Until then the old plan is followed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing import stages
from mjx_grasp.closing.closer import Closer, CloserState
from mjx_grasp.closing.learned import (
    LearnedPolicy,
    first_stack,
    observation,
    observed_step,
    pushed,
    told,
)
from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import norm, turned_back
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.pipeline.pose_filter import estimated, start_estimate
from mjx_grasp.pipeline.pressing import budget_for, force_of_plan, preloaded
from mjx_grasp.pipeline.servo import Servos, follow_velocity, joint_servos
from mjx_grasp.pipeline.state import (
    ClosingMemory,
    GraspState,
    GraspTick,
    Handoff,
    Known,
    Seen,
    Tried,
    Ways,
    smoothed,
    to_object,
    to_world,
)
from mjx_grasp.pipeline.worlds import for_those
from mjx_grasp.posture.library import Library
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.fields import midpoint
from mjx_grasp.reaching.planning import Planner
from mjx_grasp.reaching.state import Plans, ReachOutcome, ReachState
from mjx_grasp.robot.interface import Measured


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Grasper:
    """Controller of one robot with one set of settings; static under jit.

    One world costs what its phase costs; many are `Grasper.ticks`.
    """

    reacher: Reacher
    closer: Closer
    config: GrasperConfig
    servos: Servos
    planner: Planner | None = None
    """looks for ways to reach; without one the selection alone decides, as published"""
    policy: LearnedPolicy | None = None
    """closes on top of the model-based command; without one that is alone"""

    @classmethod
    def of(
        cls,
        reacher: Reacher,
        closer: Closer,
        config: GrasperConfig | None = None,
        planner: Planner | None = None,
        policy: LearnedPolicy | None = None,
    ) -> Grasper:
        """The controller of the robot that both parts are for.

        Raises:
            InputError: Their control periods differ.
        """
        periods = reacher.config.controller.dt, closer.config.control_dt
        if periods[0] != periods[1]:
            raise InputError("control_dt", periods, "the same of reaching and closing")
        servos = joint_servos(reacher.body.robot)
        return cls(reacher, closer, config or GrasperConfig(), servos, planner, policy)

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self.closer.config.control_dt

    def plan(
        self,
        library: Library,
        known: Known,
        seen: Seen,
        q: Float[Array, " n"],
        key: Array,
        tried: Tried | None = None,
    ) -> Ways | None:
        """Ways to grasp the object where it is; an event, much dearer than a tick.

        Args:
            library: From `start_library`.
            known: The object.
            seen: Where it is, and what is in the way.
            q: Measured joint positions [rad].
            key: Of what is tried at random.
            tried: `GraspState.tried`, nothing by default. Another way is not looked for near the
                contact of one that has failed; and the more have, the farther from an anchor.
        """
        if self.planner is None:
            return None
        still = jnp.zeros((len(seen.obstacles), 3))
        around = Surroundings.still(known.shape, seen.p_wo, seen.R_wo, known.com, known.weight)
        around = around._replace(obstacles=seen.obstacles, obstacle_velocity=still)
        tried = tried or Tried.nothing()
        away = norm(known.candidates.thumb - tried.avoid) >= self.config.avoided
        candidates = known.candidates._replace(valid=known.candidates.valid & away)
        plans = self.planner.search(library, candidates, around, q, key, tried.failures).plans
        targets, grip = self.reacher.selection.targets, self.closer.config.grip

        def force(plan: Plans) -> Float[Array, ""]:
            return force_of_plan(known, seen, plan, targets, grip, self.config)

        return Ways(plans, jax.vmap(force)(plans), seen.p_wo, seen.R_wo, tried.failures)

    def start(
        self, measured: Measured, known: Known, seen: Seen, ways: Ways | None = None
    ) -> GraspState:
        """The state at the start of a grasp.

        Args:
            measured: Now.
            known: The object.
            seen: Where it is.
            ways: From `plan`.
        """
        phases = jnp.full(len(Phase), jnp.nan, jnp.float32)
        never = jnp.float32(jnp.nan)
        return GraspState(
            phase=jnp.int32(Phase.REACHING),
            failure=jnp.int32(Failure.NONE),
            clock=jnp.float32(0.0),
            entered=phases.at[Phase.REACHING].set(0.0),
            returns=jnp.int32(0),
            retries=jnp.int32(0),
            vain=jnp.int32(0),
            avoid=jnp.full(3, jnp.inf, jnp.float32),
            pose=start_estimate(seen.p_wo, seen.R_wo),
            reach=self._start_reach(measured, known, seen, ways),
            ways=ways,
            reference=measured.q,
            target=measured.q,
            closing=self._start_closing(measured),
            handoff=Handoff(jnp.full(3, jnp.nan, jnp.float32), never),
        )

    def adopt(self, state: GraspState, ways: Ways) -> GraspState:
        """Goes on with new plans, while it reaches: for a grasp that has begun they come too late.

        Where the object is elsewhere than they were made for, or a try has failed since, newer ones
        are due at once.
        """
        reach = self.reacher.adopt(state.reach, ways.plans, ways.p_wo, ways.R_wo)
        reach = reach._replace(stale=ways.failures != state.tried.failures)
        reaches = state.phase == Phase.REACHING
        reach, ways = jax.tree.map(
            lambda new, old: jnp.where(reaches, new, old), (reach, ways), (state.reach, state.ways)
        )
        return state._replace(reach=reach, ways=ways)

    def tick(
        self, state: GraspState, measured: Measured, known: Known, seen: Seen
    ) -> tuple[GraspState, GraspTick]:
        """One control period.

        Args:
            state: From `start` or the last tick.
            measured: Now.
            known: The object.
            seen: Where it is now, what touches, what is in the way.
        """
        state, seen = self._noticed(state, seen)
        parts = (self._reach, self._close, self._close, self._close, self._stop)
        after, done = jax.lax.switch(state.phase, parts, state, measured, known, seen)
        after, anew = self._begins_again(state, after)
        reach = jax.lax.cond(
            anew,
            lambda: self._reach_again(measured, known, seen, state.ways),
            lambda: after.reach,
        )
        return self._settled(state, after._replace(reach=reach), done)

    def ticks(
        self, state: GraspState, measured: Measured, known: Known, seen: Seen
    ) -> tuple[GraspState, GraspTick]:
        """`tick` of many worlds: reaching, by far the dearest phase, for those alone that reach.

        Args:
            state: Of each world, stacked, as all that follows.
            measured: Now.
            known: Their objects.
            seen: Where they are now, what touches, what is in the way.
        """
        state, seen = jax.vmap(self._noticed)(state, seen)

        def reached(given: tuple[Any, ...]) -> _Reached:
            return _Reached.of(*self._reach(*given))

        def begun(given: tuple[Any, ...]) -> ReachState:
            return self._reach_again(*given)

        def otherwise(state: GraspState, *given: Any) -> tuple[GraspState, GraspTick]:
            closes = (state.phase != Phase.REACHING) & (state.phase != Phase.FAILED)
            return jax.lax.cond(closes, self._close, self._stop, state, *given)

        rest = jax.vmap(otherwise)(state, measured, known, seen)
        reaches, now = state.phase == Phase.REACHING, (state, measured, known, seen)
        found = for_those(reaches, reached, now, _Reached.of(*rest))
        after, done = found.put(rest[0])
        after, anew = jax.vmap(self._begins_again)(state, after)
        given = measured, known, seen, state.ways
        reach = for_those(anew, begun, given, after.reach, cheap=True)
        after = after._replace(reach=reach)
        return jax.vmap(self._settled)(state, after, done)

    def _noticed(self, state: GraspState, seen: Seen) -> tuple[GraspState, Seen]:
        """A tick later, and the object where it is estimated to be."""
        pose = estimated(state.pose, seen.p_wo, seen.R_wo, self.dt, self.config.pose)
        return state._replace(clock=state.clock + self.dt, pose=pose), smoothed(seen, pose)

    def _settled(
        self, before: GraspState, after: GraspState, done: GraspTick
    ) -> tuple[GraspState, GraspTick]:
        """Once the phase is known: time-out, when it was entered, whether plans are due."""
        late = (after.phase < Phase.HOLDING) & (after.clock >= self.config.timeout_s)
        phase = jnp.where(late, Phase.FAILED, after.phase).astype(jnp.int32)
        enters = (phase != before.phase) & (jnp.arange(len(Phase)) == phase)
        due = (phase == Phase.REACHING) & after.reach.stale
        return after._replace(
            phase=phase,
            failure=jnp.where(late, Failure.TIME_OUT, after.failure).astype(jnp.int32),
            entered=jnp.where(enters, before.clock, after.entered),
            target=done.target,
        ), done._replace(plans_due=due & (before.ways is not None))

    def _start_reach(
        self, measured: Measured, known: Known, seen: Seen, ways: Ways | None
    ) -> ReachState:
        plans = None if ways is None else ways.plans
        reach = self.reacher.start(
            measured.q, known.candidates, seen.p_wo, seen.R_wo, plans, len(seen.obstacles)
        )
        return reach if ways is None else reach._replace(planned_p=ways.p_wo, planned_R=ways.R_wo)

    def _start_closing(self, measured: Measured) -> ClosingMemory:
        """Before any handoff: of the right shapes, and void."""
        points = ThreePoints(measured.pad_pos, -measured.pad_mat[..., 0])
        closer = self.closer.start(measured, points)
        action = jnp.zeros(self.closer.action_size)
        return ClosingMemory(
            fresh=jnp.asarray(True),
            contacts=points,
            closer=closer,
            action=action,
            stack=self._first_stack(closer, measured, points, action),
            in_palm=jnp.zeros(3),
        )

    def _reach(
        self, state: GraspState, measured: Measured, known: Known, seen: Seen
    ) -> tuple[GraspState, GraspTick]:
        """A tick of reaching; its own gate hands off, its own time-outs re-select and fail."""
        reach, done = self.reacher.tick(
            state.reach,
            measured.q,
            known.shape,
            known.candidates,
            seen.p_wo,
            seen.R_wo,
            seen.obstacles,
            None if state.ways is None else state.ways.plans,
            state.pose.twist,
        )
        reference, target = follow_velocity(
            state.reference, measured.q, done.velocity, self.dt, self.servos, self.config.servo
        )
        points = ThreePoints(done.targets.position, done.targets.normal)
        hands_off = reach.outcome == ReachOutcome.HANDOFF
        reason = jnp.select(
            [reach.outcome == ReachOutcome.FAILED, reach.outcome == ReachOutcome.NO_CANDIDATE],
            [Failure.NOT_REACHED, Failure.NO_CANDIDATE],
            Failure.NONE,
        )
        phase = jnp.where(hands_off, Phase.CLOSING, Phase.REACHING)
        contacts = to_object(points, seen)
        handoff = Handoff(done.report.error, done.report.midpoint)
        state = state._replace(
            phase=jnp.where(reason != Failure.NONE, Phase.FAILED, phase).astype(jnp.int32),
            failure=reason.astype(jnp.int32),
            reach=reach,
            reference=reference,
            closing=state.closing._replace(fresh=jnp.asarray(True), contacts=contacts),
            handoff=jax.tree.map(
                lambda new, old: jnp.where(hands_off, new, old), handoff, state.handoff
            ),
        )
        return state, self._did(target, points, done.report.error)

    def _close(
        self, state: GraspState, measured: Measured, known: Known, seen: Seen
    ) -> tuple[GraspState, GraspTick]:
        """A tick of closing, lifting or holding; the closer's own stages tell when the lift is."""
        before, config = state.closing, self.config
        points = to_world(before.contacts, seen)
        fresh = before.fresh
        begun = self.closer.start(measured, points)
        sensed = self.closer.sense(before.closer, measured, points, seen.touching)
        closer = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), begun, sensed)
        if state.ways is not None:
            force, grip = state.ways.force[state.reach.plan], self.closer.config.grip
            closer = preloaded(closer, before.contacts.position, force, grip, config)
        action = jnp.where(fresh, 0.0, before.action)
        first = self._first_stack(closer, measured, points, action)
        stack = jnp.where(fresh, first, pushed(before.stack, first[-1]))
        action = self._action(closer, stack, known)
        closer, target = self.closer.act(closer, measured, points, action)

        in_palm = turned_back(measured.palm_mat, seen.p_wo - measured.palm_pos)
        kept = jnp.where(closer.lifting, before.in_palm, in_palm)
        displaced = norm(in_palm - kept)
        elsewhere = norm(midpoint(measured.pad_pos) - midpoint(points.position))
        top = closer.lift_tick * self.dt >= stages.lift_duration(self.closer.config.lift)
        moved = ~closer.lifting & (elsewhere > config.lost)
        no_contact = ~closer.lifting & ~moved & (closer.tick * self.dt >= config.contact_s)
        lost = closer.lifting & (displaced > config.dropped)
        followed = state.returns - (state.retries - state.vain)
        too_often = moved & (followed >= config.follows)
        retries = (lost | no_contact | too_often) & (state.retries < config.retries)
        goes_back = moved | retries
        reason = jnp.select(
            [goes_back, lost, no_contact],
            [Failure.NONE, Failure.DROPPED, Failure.NO_CONTACT],
            Failure.NONE,
        )
        phase = jnp.select(
            [reason != Failure.NONE, goes_back, top, closer.lifting],
            [Phase.FAILED, Phase.REACHING, Phase.HOLDING, Phase.LIFTING],
            Phase.CLOSING,
        )
        state = state._replace(
            phase=phase.astype(jnp.int32),
            failure=reason.astype(jnp.int32),
            returns=state.returns + goes_back,
            retries=state.retries + retries,
            avoid=jnp.where(retries, before.contacts.position[0], state.avoid),
            reference=measured.q,
            closing=ClosingMemory(
                fresh=goes_back,
                contacts=before.contacts,
                closer=closer,
                action=action,
                stack=stack,
                in_palm=kept,
            ),
        )
        return state, self._did(target, points, norm(points.position - measured.pad_pos))

    def _begins_again(
        self, before: GraspState, after: GraspState
    ) -> tuple[GraspState, Bool[Array, ""]]:
        """Whether reaching starts anew: after closing, and once where it was in vain."""
        in_vain = after.failure == Failure.NOT_REACHED
        in_vain &= (before.failure == Failure.NONE) & (after.retries < self.config.retries)
        phase = jnp.where(in_vain, Phase.REACHING, after.phase).astype(jnp.int32)
        after = after._replace(
            phase=phase,
            failure=jnp.where(in_vain, Failure.NONE, after.failure).astype(jnp.int32),
            retries=after.retries + in_vain,
            vain=after.vain + in_vain,
        )
        return after, in_vain | ((phase == Phase.REACHING) & (before.phase != Phase.REACHING))

    def _reach_again(
        self, measured: Measured, known: Known, seen: Seen, ways: Ways | None
    ) -> ReachState:
        """The start of a reach that waits for new plans."""
        begun = self._start_reach(measured, known, seen, ways)
        return begun._replace(stale=jnp.asarray(ways is not None))

    def _stop(
        self, state: GraspState, measured: Measured, known: Known, seen: Seen
    ) -> tuple[GraspState, GraspTick]:
        """Holds still."""
        points = to_world(state.closing.contacts, seen)
        return state, self._did(state.target, points, norm(points.position - measured.pad_pos))

    def _did(
        self, target: Float[Array, " n"], points: ThreePoints, error: Float[Array, " 3"]
    ) -> GraspTick:
        return GraspTick(target, jnp.asarray(False), points, error)

    def _first_stack(
        self,
        closer: CloserState,
        measured: Measured,
        points: ThreePoints,
        action: Float[Array, " a"],
    ) -> Float[Array, "s d"]:
        """The policy's observations as if all had been as it is now; none without a policy."""
        if self.policy is None:
            return jnp.zeros((1, 0))
        seen = self.policy.observation
        step = observed_step(self.closer, closer, measured, points, action, seen)
        return first_stack(step, seen)

    def _action(
        self, closer: CloserState, stack: Float[Array, "s d"], known: Known
    ) -> Float[Array, " a"]:
        if self.policy is None:
            return jnp.zeros(self.closer.action_size)
        seen = self.policy.observation
        given = budget_for(known.weight, self.policy.budget, self.config)
        budget = told(given, closer, self.dt, seen.keeping)
        return jnp.clip(self.policy.answer(observation(stack, budget, seen)), -1, 1)


class _Reached(NamedTuple):
    """What a tick of reaching changes, so that nothing else is moved to and fro."""

    phase: Int[Array, "*w"]
    failure: Int[Array, "*w"]
    reach: ReachState
    reference: Float[Array, "*w n"]
    fresh: Bool[Array, "*w"]
    contacts: ThreePoints
    handoff: Handoff
    done: GraspTick

    @classmethod
    def of(cls, state: GraspState, done: GraspTick) -> _Reached:
        """Taken from a state and its tick."""
        closing = state.closing
        return cls(
            state.phase,
            state.failure,
            state.reach,
            state.reference,
            closing.fresh,
            closing.contacts,
            state.handoff,
            done,
        )

    def put(self, state: GraspState) -> tuple[GraspState, GraspTick]:
        """Put into a state, and its tick."""
        changed = self._asdict()
        done, fresh, contacts = (changed.pop(name) for name in ("done", "fresh", "contacts"))
        closing = state.closing._replace(fresh=fresh, contacts=contacts)
        return state._replace(**changed, closing=closing), done
