"""The closing task: handoff in, lifted object out (method §5).

Written once over `Measured` and `Truth`, so that MJX and native MuJoCo run the same logic. All
worlds advance together; every function takes and returns batches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing import control
from mjx_grasp.closing.closer import Closer, CloserState
from mjx_grasp.closing.learned import first_stack, observation, observed_step, pushed, told
from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Physics, PhysicsState, Truth, WorldParams
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise
from mjx_grasp.tasks.observation import privileged
from mjx_grasp.tasks.rewards import Moment, RewardTerm, closing_terms
from mjx_grasp.tasks.robot_errors import RobotDraw, arriving, as_sensed, longest_delay
from mjx_grasp.tasks.starts import (
    StartDraw,
    StartTable,
    balanced_weights,
    draw_params,
    draw_starts,
    placed_object,
)
from mjx_grasp.tasks.success import (
    Progress,
    failure_classes,
    in_palm,
    initial_progress,
    slipped,
    update_progress,
)
from mjx_grasp.tasks.task import EpisodeSummary, Observations, TaskTick


class Episode(NamedTuple):
    """What the task remembers of each world beside its controller."""

    row: Int[Array, " w"]
    """of the start table"""
    action: Float[Array, "w k"]
    last_action: Float[Array, "w k"]
    stack: Float[Array, "w s d"]
    """the last steps of the observation, oldest first"""
    budget: Float[Array, " w"]
    """that the mean force per finger may be [N]"""
    robot: RobotDraw
    sent: tuple[Float[Array, "w n"], ...]
    """commands on their way, oldest first [rad]"""
    reset_height: Float[Array, " w"]
    """of the object origin at the start [m]"""
    object_in_palm: Float[Array, "w 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress
    force_sum: Float[Array, " w"]
    """over the ticks since lift onset, of the mean finger force [N]"""
    force_peak: Float[Array, " w"]
    """largest force on one finger since lift onset [N]"""
    held_force_sum: Float[Array, " w"]
    """as `force_sum`, over the ticks in which the object is held off the table [N]"""
    held_ticks: Int[Array, " w"]
    """the number of those ticks"""


class Standing(NamedTuple):
    """A robot at rest where an episode begins, with its controller; a row of a table."""

    qpos: Float[Array, "n nq"]
    ctrl: Float[Array, "n nu"]
    measured: Measured
    closer: CloserState


class ClosingState(NamedTuple):
    """All that the task carries from tick to tick."""

    physics: PhysicsState
    params: WorldParams
    measured: Measured
    truth: Truth
    closer: CloserState
    episode: Episode
    beside: Any = ()
    """what a task that builds on this one remembers over resets"""


class ClosingTask:
    """Closing and lifting from handoffs, on one engine; a `Task`.

    Args:
        physics: The engine.
        starts: Start states.
        config: The task.
        noise: What resets draw.
        with_privileged: Whether observations hold `privileged_state` for the critic.
        extra_terms: Reward terms beside those of the publication.

    Raises:
        InputError: Two reward terms have one name.
    """

    def __init__(
        self,
        physics: Physics,
        starts: StartTable,
        config: ClosingTaskConfig | None = None,
        noise: StartNoise | None = None,
        with_privileged: bool = True,
        extra_terms: tuple[RewardTerm, ...] = (),
    ):
        self.physics, self.starts = physics, starts
        self.config, self.noise = config or ClosingTaskConfig(), noise or StartNoise()
        self.closer = self._controller()
        self.terms = (*closing_terms(self.config.reward), *extra_terms)
        self.reward_names = tuple(term.name for term in self.terms)
        if len(set(self.reward_names)) < len(self.terms):
            raise InputError("extra_terms", ", ".join(self.reward_names), "another name for each")
        self.action_size = self.closer.action_size
        self.control_dt = self.config.control_dt
        self.episode_ticks = self.config.episode_ticks
        self._with_privileged = with_privileged
        self._feels = self.config.observation.forces
        self._weights = balanced_weights(starts.object_index, len(physics.scene.objects))
        self._ctrl_order = np.argsort(physics.scene.addresses.robot_ctrl)
        self._turned = self.noise.angle_rad > 0
        # Of every start once: a reset gathers its rows.
        self._standing = self._table()

    def draw(self, key: Array, worlds: int) -> StartDraw:
        """See `Task.draw`."""
        return draw_starts(key, worlds, self.noise, self._weights)

    def start(self, draw: StartDraw) -> tuple[ClosingState, Observations]:
        """See `Task.start`."""
        qpos, ctrl = self._start_arrays(draw)
        fresh = self._fresh(draw, qpos)
        state = ClosingState(self.physics.init(qpos, ctrl), *fresh, self._beside(len(draw.row)))
        return state, self._observe(state)

    def reset(
        self, state: ClosingState, mask: Bool[Array, " w"], draw: StartDraw
    ) -> tuple[ClosingState, Observations]:
        """See `Task.reset`."""
        qpos, ctrl = self._start_arrays(draw)

        def select(new: Array, old: Array) -> Array:
            return jnp.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        physics = self.physics.reset(state.physics, mask, qpos, ctrl)
        fresh = jax.tree.map(select, self._fresh(draw, qpos), tuple(state[1:-1]))
        state = ClosingState(physics, *fresh)._replace(beside=state.beside)
        return state, self._observe(state)

    def tick(
        self, state: ClosingState, action: Float[Array, "w k"]
    ) -> tuple[ClosingState, TaskTick]:
        """See `Task.tick`; an action is what `Closer.action_size` counts."""
        action = jnp.clip(action, -1.0, 1.0)
        targets = self._targets(state.episode.row, state.truth)
        closer, target = self.closer.act(state.closer, state.measured, targets, action)
        robot, errors, joints = state.episode.robot, self.noise.robot, self.closer.joints
        target, sent = arriving(
            target, state.episode.sent, robot, state.measured, joints, self.control_dt
        )
        physics, measured, truth = self.physics.step(
            state.physics, state.params, target[:, self._ctrl_order]
        )
        measured = as_sensed(measured, robot, closer.tick, joints, errors)
        finite = jnp.isfinite(measured.q).all(-1) & jnp.isfinite(truth.object_pos).all(-1)

        row = state.episode.row
        before = _distance(state.measured, targets)
        targets = self._targets(row, truth)
        nearer = before - _distance(measured, targets)
        homing = self._homing(state.measured, measured, row)
        sensed = self.closer.sense(closer, measured, targets, truth.tip_found)
        followed = state.episode._replace(sent=sent)
        episode, slip = self._followed(followed, closer, sensed, measured, truth, targets, action)
        lift_force = _lift_force(episode, sensed)
        moment = self._moment(
            closer,
            measured,
            truth,
            targets,
            slip,
            nearer,
            homing,
            lift_force,
            action,
            state.episode,
        )
        rewards = {
            term.name: jnp.where(finite, term.weight * term.value(moment), 0.0)
            for term in self.terms
        }
        after = (measured, truth, sensed, episode, state.beside)
        state = ClosingState(physics, state.params, *after)
        told = ~finite, truth.overflow, self._over(state)
        return state, TaskTick(self._observe(state), rewards, *told)

    def summary(self, state: ClosingState) -> EpisodeSummary:
        """See `Task.summary`."""
        episode, closer = state.episode, state.closer
        return EpisodeSummary(
            row=episode.row,
            success=episode.progress.success,
            **failure_classes(episode.progress),
            lifting=closer.lifting,
            force_mean=_lift_force(episode, closer),
            force_peak=episode.force_peak,
            force_held=episode.held_force_sum / episode.held_ticks,  # 0 / 0 is nan: none
            peak_rise=episode.progress.peak_rise,
        )

    def snapshot(self, state: ClosingState) -> dict[str, Array]:
        """See `Task.snapshot`."""
        return {**state.physics._asdict(), "row": state.episode.row}

    def pack(self, state: ClosingState) -> dict[str, Any]:
        """See `Task.pack`."""
        packed = {"physics": state.physics, "rest": tuple(state[1:-1])}
        # Only where there is something: checkpoints of before have no such entry.
        return packed | ({"beside": state.beside} if state.beside else {})

    def unpack(self, packed: dict[str, Any]) -> ClosingState:
        """See `Task.unpack`."""
        state = ClosingState(packed["physics"], *packed["rest"])
        return state._replace(beside=packed.get("beside", ()))

    def _controller(self) -> Closer:
        return Closer.of(self.physics.scene.robot, self.config)

    def _table(self) -> Standing:
        """All beginnings of episodes."""
        starts = self.starts
        closer = self.closer.start(starts.measured, starts.targets)
        return Standing(starts.qpos, starts.ctrl, starts.measured, closer)

    def _beginning(self, draw: StartDraw) -> Int[Array, " w"]:
        """Which of them a draw means."""
        return draw.row

    def _beside(self, worlds: int) -> Any:
        """What the state holds beside at first."""
        return ()

    def _over(self, state: ClosingState) -> Bool[Array, " w"]:
        """Which episodes have failed before their time."""
        return jnp.zeros(len(state.episode.row), bool)

    def _homing(
        self, before: Measured, after: Measured, row: Int[Array, " w"]
    ) -> Float[Array, " w"]:
        """By how much the joints have come nearer to the start state's; here it begins there."""
        return jnp.zeros(len(row))

    def _targets(self, row: Int[Array, " w"], truth: Truth) -> ThreePoints:
        """The contacts to close on: those of the handoff, wherever the object is now."""
        return jax.tree.map(lambda rows: rows[row], self.starts.targets)

    def _moment(
        self,
        closer: CloserState,
        measured: Measured,
        truth: Truth,
        targets: ThreePoints,
        slip: Float[Array, " w"],
        nearer: Float[Array, " w"],
        homing: Float[Array, " w"],
        lift_force: Float[Array, " w"],
        action: Float[Array, "w k"],
        before: Episode,
    ) -> Moment:
        at = self.closer.joints.at
        palm = control.palm_jacobian(measured, at.arm)
        return Moment(
            measured=measured,
            truth=truth,
            lifting=closer.lifting,
            in_time=closer.tick * self.control_dt <= self.closer.config.stages.acquisition_s,
            guidance=self.closer.guidance(closer, measured, targets),
            pad_twist=control.pad_twists(measured, at),
            palm_velocity=jnp.sum(palm[:, :3] * measured.qd[:, None, at.arm], axis=-1),
            lift_speed=self.closer.lift_speed(closer),
            slip=slip,
            nearer=nearer,
            homing=homing,
            lift_force=lift_force,
            budget=before.budget,
            action=action,
            last_action=before.action,
            before_last=before.last_action,
        )

    def _followed(
        self,
        before: Episode,
        closer: CloserState,
        sensed: CloserState,
        measured: Measured,
        truth: Truth,
        targets: ThreePoints,
        action: Float[Array, "w k"],
    ) -> tuple[Episode, Float[Array, " w"]]:
        """What came of the tick, and how far the object has slipped in the palm [m]."""
        here = in_palm(measured, truth)
        reference, slip = slipped(before.object_in_palm, closer.lifting, sensed.lifting, here)
        rise = truth.object_pos[:, 2] - before.reset_height
        force = jnp.linalg.norm(truth.finger_force, axis=-1)
        lifted_force = jnp.where(sensed.lifting[:, None], force, 0.0)
        held = sensed.lifting & (rise > _OFF_THE_TABLE_M) & (slip < self.config.success.slip)
        step = self._step(sensed, measured, targets, action)
        episode = before._replace(
            action=action,
            last_action=before.action,
            stack=pushed(before.stack, step),
            object_in_palm=reference,
            progress=update_progress(
                before.progress,
                rise,
                slip,
                sensed.lifting,
                self.config.success,
                self.config.control_dt,
            ),
            force_sum=before.force_sum + jnp.mean(lifted_force, axis=-1),
            force_peak=jnp.maximum(before.force_peak, jnp.max(lifted_force, axis=-1)),
            held_force_sum=before.held_force_sum + jnp.where(held, jnp.mean(force, axis=-1), 0.0),
            held_ticks=before.held_ticks + held,
        )
        return episode, slip

    def _step(
        self, closer: CloserState, measured: Measured, targets: ThreePoints, action: Array
    ) -> Float[Array, "w d"]:
        """The observation of one tick."""
        seen = self.config.observation
        return observed_step(self.closer, closer, measured, targets, action, seen)

    def _observe(self, state: ClosingState) -> Observations:
        episode, closer = state.episode, state.closer
        seen = self.config.observation
        budget = told(episode.budget, closer, self.control_dt, seen.keeping)
        proprio = observation(episode.stack, budget, seen)
        if not (self._with_privileged or seen.truth):
            return {"state": proprio}
        measured, truth, ticks = state.measured, state.truth, self.episode_ticks
        force = self.closer.grip_force(closer)
        critic = privileged(
            proprio,
            measured,
            truth,
            self._targets(episode.row, truth),
            closer.landed,
            scalars=(
                closer.lifting.astype(jnp.float32),
                closer.tick / ticks,
                closer.lift_tick / ticks,
                (truth.object_pos[:, 2] - episode.reset_height) * 10.0,
                jnp.linalg.norm(in_palm(measured, truth) - episode.object_in_palm, axis=-1) * 20.0,
                state.params.friction,
                state.params.mass_scale,
                *((force * 0.2, episode.budget * 0.2) if self._feels else ()),
            ),
        )
        read = {"state": critic if seen.truth else proprio}
        return read | ({"privileged_state": critic} if self._with_privileged else {})

    def _start_arrays(self, draw: StartDraw) -> tuple[Float[Array, "w nq"], Float[Array, "w nu"]]:
        at, k = self.physics.scene.addresses, self._beginning(draw)
        pose = placed_object(self.starts, draw, self._turned)
        qpos = self._standing.qpos[k].at[:, at.object_qpos].set(pose)
        return qpos, self._standing.ctrl[k]

    def _fresh(
        self, draw: StartDraw, qpos: Float[Array, "w nq"]
    ) -> tuple[WorldParams, Measured, Truth, CloserState, Episode]:
        """All but the physics of worlds that start."""
        at, starts = self.physics.scene.addresses, self.starts
        k, standing = self._beginning(draw), self._standing
        measured, closer = jax.tree.map(lambda rows: rows[k], (standing.measured, standing.closer))
        if draw.force is not None:
            closer = closer._replace(level=draw.force)
        truth = jax.tree.map(lambda rows: rows[draw.row], starts.truth)
        truth = truth._replace(
            object_pos=qpos[:, at.object_qpos[:3]], object_quat=qpos[:, at.object_qpos[3:]]
        )
        w = len(draw.row)
        action, zeros = jnp.zeros((w, self.action_size)), jnp.zeros(w)
        first = self._step(closer, measured, self._targets(draw.row, truth), action)
        delay = longest_delay(self.noise.robot, self.control_dt)
        episode = Episode(
            row=draw.row,
            action=action,
            last_action=action,
            stack=first_stack(first, self.config.observation),
            budget=draw.budget,
            robot=draw.robot,
            sent=(measured.q,) * delay,
            reset_height=truth.object_pos[:, 2],
            object_in_palm=in_palm(measured, truth),
            progress=initial_progress((w,)),
            force_sum=zeros,
            force_peak=zeros,
            held_force_sum=zeros,
            held_ticks=jnp.zeros(w, jnp.int32),
        )
        return draw_params(starts, draw), measured, truth, closer, episode


def _lift_force(episode: Episode, closer: CloserState) -> Float[Array, " w"]:
    """Mean force per finger since lift onset, 0 before [N]."""
    return episode.force_sum / (closer.lift_tick + 1)  # the onset's own tick counts


def _distance(measured: Measured, targets: ThreePoints) -> Float[Array, " w"]:
    """Of the pads from their contacts, mean, of an object that is within reach [m]."""
    distance = norm(targets.position - measured.pad_pos)
    return jnp.mean(jnp.minimum(distance, _OUT_OF_REACH_M), axis=-1)


_OUT_OF_REACH_M = 1.0
"""An object that has rolled off the table falls away for as long as the episode lasts."""


_OFF_THE_TABLE_M = 0.01
"""Rise from which an object counts as held off the table."""
