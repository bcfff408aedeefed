"""The closing environment: handoff in, lifted object out (method §5).

Written once over `Readings`, so that MJX and native MuJoCo run the same logic. All worlds advance
together; every function takes and returns batches.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing import control, stages
from mjx_grasp.closing.config import ClosingConfig, StartNoise
from mjx_grasp.closing.guidance import guidance_field, way_left
from mjx_grasp.closing.observer import ObserverState, initial_observer, observe
from mjx_grasp.sim.physics import Physics, PhysicsState, Readings, WorldParams
from mjx_grasp.tasks import rewards
from mjx_grasp.tasks.observation import STACKED_STEPS, policy_sizes, privileged, proprioception
from mjx_grasp.tasks.starts import (
    StartDraw,
    StartTable,
    balanced_weights,
    draw_params,
    draw_starts,
    placed_object,
)
from mjx_grasp.tasks.success import Outcome, initial_outcome, update_outcome


class Episode(NamedTuple):
    """The task's own state of each world."""

    row: Int[Array, " w"]
    """Row of the start table."""
    tick: Int[Array, " w"]
    deadline: Int[Array, " w"]
    """The tick at which the episode is cut; earlier in the staggered first one."""
    lifting: Bool[Array, " w"]
    lift_tick: Int[Array, " w"]
    landed: Bool[Array, "w f"]
    grip_ticks: Int[Array, "w f"]
    """Ticks since the finger landed or arrived, whichever was first."""
    hold: Float[Array, "w f j"]
    """Guided finger joint targets [rad]."""
    residual: Float[Array, "w m"]
    """The policy's share of the finger targets [rad]."""
    arm: Float[Array, "w a"]
    """Arm joint targets [rad]."""
    action: Float[Array, "w k"]
    last_action: Float[Array, "w k"]
    stack: Float[Array, "w s d"]
    """The last steps of proprioception, oldest first."""
    observer: ObserverState
    observed: Bool[Array, "w f"]
    """Contact flags of the observer."""
    reset_height: Float[Array, " w"]
    object_in_palm: Float[Array, "w 3"]
    """Object origin in the palm frame, followed until lift onset and then kept [m]."""
    outcome: Outcome
    total_reward: Float[Array, " w"]
    force_sum: Float[Array, " w"]
    """Sum over the ticks since lift onset of the mean finger force [N]."""
    force_peak: Float[Array, " w"]
    """Largest force on one finger since lift onset [N]."""
    broken: Bool[Array, " w"]
    """Whether the state stopped being finite."""


class EnvState(NamedTuple):
    """All that the environment carries from tick to tick."""

    physics: PhysicsState
    params: WorldParams
    readings: Readings
    episode: Episode


class Tick(NamedTuple):
    """What a control tick yields besides the next state."""

    obs: dict[str, Array]
    """`state` [w, 66] and, if asked for, `privileged_state`."""
    reward: Float[Array, " w"]
    truncated: Bool[Array, " w"]
    """The time was up: not the task's doing."""
    broken: Bool[Array, " w"]
    """The world was not finite and has to be reset."""


class ClosingEnv:
    """The closing task on one engine.

    Args:
        physics: The engine.
        starts: Start states.
        config: The task.
        noise: What resets draw.
        with_privileged: Whether observations hold `privileged_state` for the critic.
    """

    def __init__(
        self,
        physics: Physics,
        starts: StartTable,
        config: ClosingConfig | None = None,
        noise: StartNoise | None = None,
        with_privileged: bool = True,
    ):
        self.physics, self.starts = physics, starts
        self.config, self.noise = config or ClosingConfig(), noise or StartNoise()
        self.with_privileged = with_privileged
        scene = physics.scene
        self.joints = control.joint_map(scene)
        self.num_fingers = len(scene.robot.hand.fingers)
        _, self.action_size = policy_sizes(scene.robot)
        self._weights = balanced_weights(starts.object_index, len(scene.objects))
        self._turned = self.noise.angle_rad > 0

    def draw(self, key: Array, worlds: int) -> StartDraw:
        """Draws starts, every object of the table equally often."""
        return draw_starts(key, worlds, self.starts, self.noise, self._weights)

    def start(self, draw: StartDraw) -> tuple[EnvState, dict[str, Array]]:
        """A fresh state of all worlds and its observation."""
        qpos, ctrl = self._start_arrays(draw)
        physics = self.physics.init(qpos, ctrl)
        state = EnvState(
            physics,
            draw_params(self.starts, draw),
            self._start_readings(draw, qpos),
            self._start_episode(draw, qpos),
        )
        return state, self._observe(state)

    def reset(
        self, state: EnvState, mask: Bool[Array, " w"], draw: StartDraw
    ) -> tuple[EnvState, dict[str, Array]]:
        """Starts the masked worlds anew and leaves the others as they are."""
        qpos, ctrl = self._start_arrays(draw)
        fresh = (
            draw_params(self.starts, draw),
            self._start_readings(draw, qpos),
            self._start_episode(draw, qpos),
        )

        def select(new: Array, old: Array) -> Array:
            return jnp.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        state = EnvState(
            self.physics.reset(state.physics, mask, qpos, ctrl),
            *jax.tree.map(select, fresh, (state.params, state.readings, state.episode)),
        )
        return state, self._observe(state)

    def tick(self, state: EnvState, action: Float[Array, "w k"]) -> tuple[EnvState, Tick]:
        """One control tick without a reset.

        Args:
            state: The worlds.
            action: Policy actions, clipped to ±1: finger residuals, then arm residuals.
        """
        action = jnp.clip(action, -1.0, 1.0)
        episode, ctrl = self._command(state, action)
        physics, readings = self.physics.step(state.physics, state.params, ctrl)
        guidance = self._guidance(episode, readings)
        episode, reward = self._judge(episode, readings, guidance, state.episode, action)
        state = EnvState(physics, state.params, readings, episode)
        return state, Tick(
            self._observe(state), reward, episode.tick >= episode.deadline, episode.broken
        )

    def _command(
        self, state: EnvState, action: Float[Array, "w k"]
    ) -> tuple[Episode, Float[Array, "w nu"]]:
        """Guided targets, grip force and scripted lift, plus the policy's residuals."""
        config, joints, readings, episode = self.config, self.joints, state.readings, state.episode
        worlds, fingers = action.shape[0], len(joints.fingers)
        jacobian = control.pad_jacobians(readings, joints.per_finger)
        rates = control.guided_rates(jacobian, self._guidance(episode, readings), config)
        frozen = episode.landed | episode.lifting[:, None]
        hold = control.hold_until_landed(
            episode.hold, readings.q[:, joints.per_finger], rates, frozen, config
        )
        force = stages.grip_force(episode.grip_ticks, config, config.grip_force)
        inward = -self.starts.normals[episode.row]
        torque = control.grip_torques(jacobian, inward, force).reshape(worlds, fingers)
        residual = control.update_residual(episode.residual, action[:, :fingers], config)

        time = episode.lift_tick * config.control_dt
        speed = jnp.where(episode.lifting, stages.lift_speed(time, config), 0.0)
        arm_rates = control.lift_rates(
            control.palm_jacobian(readings, joints.arm_policy), speed, config
        )
        arm_rates = arm_rates + config.arm_action_rate * action[:, fingers:]
        moved = episode.arm.at[:, joints.arm_policy].add(arm_rates * config.control_dt)
        arm = jnp.clip(moved, *joints.limits[joints.arm].T)

        at = self.physics.scene.addresses
        target = hold.reshape(worlds, fingers) + residual + torque / joints.stiffness
        ctrl = self.starts.ctrl[episode.row]
        ctrl = ctrl.at[:, at.robot_ctrl[joints.arm]].set(arm)
        ctrl = ctrl.at[:, at.robot_ctrl[joints.fingers]].set(target)
        return episode._replace(hold=hold, residual=residual, arm=arm), ctrl

    def _guidance(self, episode: Episode, readings: Readings) -> Float[Array, "w f 6"]:
        return guidance_field(
            readings.pad_pos,
            readings.pad_mat,
            self.starts.readings.pad_pos[episode.row],
            self.starts.contacts[episode.row],
            self.starts.goal_mat[episode.row],
            self.config,
        )

    def _judge(
        self,
        episode: Episode,
        readings: Readings,
        guidance: Float[Array, "w f 6"],
        before: Episode,
        action: Float[Array, "w k"],
    ) -> tuple[Episode, Float[Array, " w"]]:
        """Contacts, reward, stage and outcome after the physics."""
        config, joints = self.config, self.joints
        q, qd = readings.q[:, joints.fingers], readings.qd[:, joints.fingers]
        observer, observed = observe(
            episode.observer,
            readings.external_torque,
            q,
            qd,
            joints.limits[joints.fingers],
            joints.dry_friction,
            self.physics.scene.config.physics_dt,
            config,
        )
        touching = readings.tip_found | observed
        lift_time = episode.lift_tick * config.control_dt
        palm = control.palm_jacobian(readings, joints.arm)
        palm_velocity = jnp.sum(palm[:, :3] * readings.qd[:, None, joints.arm], axis=-1)
        reward = rewards.total(
            episode.lifting,
            control.pad_twists(readings, joints),
            guidance,
            readings.tip_found,
            palm_velocity,
            stages.lift_speed(lift_time, config),
            (action, before.action, before.last_action),
            config,
        )

        begins = ~episode.lifting & stages.lift_begins(touching, episode.tick + 1, config)
        lifting = episode.lifting | begins
        landed = episode.landed | touching
        left = way_left(
            readings.pad_pos,
            self.starts.readings.pad_pos[episode.row],
            self.starts.contacts[episode.row],
        )
        late = (episode.tick * config.control_dt >= config.approach_s) | lifting
        arrived = (left < config.arrival_distance) | late[:, None]
        there = landed | arrived
        if config.grip_together:
            there = jnp.broadcast_to(there.all(axis=-1, keepdims=True), there.shape)
        gripping = there | (episode.grip_ticks > 0)
        in_palm = _in_palm(readings)
        reference = jnp.where(episode.lifting[:, None], episode.object_in_palm, in_palm)
        displacement = jnp.where(lifting, jnp.linalg.norm(in_palm - reference, axis=-1), 0.0)
        rise = readings.object_pos[:, 2] - episode.reset_height
        force = jnp.linalg.norm(readings.finger_force, axis=-1)
        lifted_force = jnp.where(lifting[:, None], force, 0.0)
        finite = jnp.isfinite(readings.q).all(-1) & jnp.isfinite(readings.object_pos).all(-1)
        reward = jnp.where(finite, reward, 0.0)
        return episode._replace(
            tick=episode.tick + 1,
            lifting=lifting,
            lift_tick=jnp.where(episode.lifting, episode.lift_tick + 1, 0),
            landed=landed,
            grip_ticks=jnp.where(gripping, episode.grip_ticks + 1, 0),
            action=action,
            last_action=before.action,
            stack=jnp.concatenate(
                [episode.stack[:, 1:], proprioception(q, qd, action)[:, None]], axis=1
            ),
            observer=observer,
            observed=observed,
            object_in_palm=reference,
            outcome=update_outcome(episode.outcome, rise, displacement, config),
            total_reward=episode.total_reward + reward,
            force_sum=episode.force_sum + jnp.mean(lifted_force, axis=-1),
            force_peak=jnp.maximum(episode.force_peak, jnp.max(lifted_force, axis=-1)),
            broken=~finite,
        ), reward

    def _observe(self, state: EnvState) -> dict[str, Array]:
        episode, readings, config = state.episode, state.readings, self.config
        proprio = episode.stack.reshape(episode.stack.shape[0], -1)
        if not self.with_privileged:
            return {"state": proprio}
        in_palm = _in_palm(readings)
        critic = privileged(
            proprio,
            readings,
            self.starts.contacts[episode.row],
            self.starts.normals[episode.row],
            landed=episode.landed,
            lifting=episode.lifting.astype(jnp.float32),
            time=episode.tick / config.episode_ticks,
            lift_time=episode.lift_tick / config.episode_ticks,
            rise=readings.object_pos[:, 2] - episode.reset_height,
            displacement=jnp.linalg.norm(in_palm - episode.object_in_palm, axis=-1),
            physics=jnp.stack([state.params.friction, state.params.mass_scale], axis=-1),
        )
        return {"state": proprio, "privileged_state": critic}

    def _start_arrays(self, draw: StartDraw) -> tuple[Float[Array, "w nq"], Float[Array, "w nu"]]:
        at = self.physics.scene.addresses
        pose = placed_object(self.starts, draw, self._turned)
        qpos = self.starts.qpos[draw.row].at[:, at.object_qpos].set(pose)
        return qpos, self.starts.ctrl[draw.row]

    def _start_readings(self, draw: StartDraw, qpos: Float[Array, "w nq"]) -> Readings:
        at = self.physics.scene.addresses
        rows = jax.tree.map(lambda x: x[draw.row], self.starts.readings)
        return rows._replace(
            object_pos=qpos[:, at.object_qpos[:3]], object_quat=qpos[:, at.object_qpos[3:]]
        )

    def _start_episode(self, draw: StartDraw, qpos: Float[Array, "w nq"]) -> Episode:
        readings, joints = self._start_readings(draw, qpos), self.joints
        w, f, m = len(draw.row), self.num_fingers, len(joints.fingers)
        zeros, ints, no = jnp.zeros(w), jnp.zeros(w, jnp.int32), jnp.zeros(w, bool)
        action = jnp.zeros((w, self.action_size))
        q, qd = readings.q[:, joints.fingers], readings.qd[:, joints.fingers]
        first = proprioception(q, qd, action)
        return Episode(
            row=draw.row,
            tick=ints,
            deadline=jnp.full(w, self.config.episode_ticks, jnp.int32),
            lifting=no,
            lift_tick=ints,
            landed=jnp.zeros((w, f), bool),
            grip_ticks=jnp.zeros((w, f), jnp.int32),
            hold=readings.q[:, joints.per_finger],
            residual=jnp.zeros((w, m)),
            arm=readings.q[:, joints.arm],
            action=action,
            last_action=action,
            stack=jnp.repeat(first[:, None], STACKED_STEPS, axis=1),
            observer=initial_observer((w,), m, f),
            observed=jnp.zeros((w, f), bool),
            reset_height=readings.object_pos[:, 2],
            object_in_palm=_in_palm(readings),
            outcome=initial_outcome((w,)),
            total_reward=zeros,
            force_sum=zeros,
            force_peak=zeros,
            broken=no,
        )


def _in_palm(readings: Readings) -> Float[Array, "w 3"]:
    """Object origin in the palm frame [m]."""
    offset = readings.object_pos - readings.palm_pos
    return jnp.sum(readings.palm_mat * offset[..., :, None], axis=-2)
