"""The closing controller: guidance to the contacts, grip, stages and scripted lift (method §5).

A pure function of what a robot measures, for one robot or any batch of them. It knows no simulator:
contact flags are an input, so that a contact solver, touch pads or nothing at all may supply them,
beside the flags of its own momentum observer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing import control, stages
from mjx_grasp.closing.config import CloserConfig
from mjx_grasp.closing.forces import (
    finger_shares,
    next_level,
    press_directions,
    pressing_and_sliding,
    tip_forces,
)
from mjx_grasp.closing.guidance import goal_frame, guidance_field, way_left
from mjx_grasp.closing.joints import DrivenJoints, action_size, driven_joints
from mjx_grasp.closing.observer import ObserverState, initial_observer, observe
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.interface import Measured


class CloserState(NamedTuple):
    """What the controller remembers."""

    tick: Int[Array, "*b"]
    """control periods commanded so far"""
    start_pos: Float[Array, "*b f 3"]
    """pads at the start [m]"""
    goal_mat: Float[Array, "*b f 3 3"]
    """R*, the pad frames at the contacts"""
    rest: Float[Array, "*b n"]
    """joints at the start; those that neither closing nor an action moves stay there [rad]"""
    hold: Float[Array, "*b f j"]
    """guided finger joint targets [rad]"""
    residual: Float[Array, "*b m"]
    """the policy's share of the finger targets [rad]"""
    arm: Float[Array, "*b a"]
    """arm joint targets [rad]"""
    observer: ObserverState
    observed: Bool[Array, "*b f"]
    """contact flags of the observer"""
    level: Float[Array, "*b"]
    """F, the grip's force per finger, before the policy's factor [N]"""
    trim: Float[Array, "*b"]
    """logarithm of that factor, as a share of its range, in ±1"""
    least: Float[Array, "*b"]
    """F that is commanded at least, whatever that factor [N]"""
    landed: Bool[Array, "*b f"]
    """whether a finger has ever touched"""
    grip_ticks: Int[Array, "*b f"]
    """since the finger landed or arrived, whichever was first"""
    lifting: Bool[Array, "*b"]
    lift_tick: Int[Array, "*b"]
    """since lift onset"""
    pressed: Float[Array, "*b"]
    """sum over the ticks since lift onset of the fingers' mean force, estimated [N]"""


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Closer:
    """Controller of one robot with one set of settings; static under jit.

    `tick` is a whole control period. It is `sense`, what the robot measured, then `act`, the
    command; whoever decides in between, as a policy does, calls the two.
    """

    config: CloserConfig
    joints: DrivenJoints

    @classmethod
    def of(cls, robot: RobotSpec, config: CloserConfig | None = None) -> Closer:
        """The controller of a robot."""
        return cls(config or CloserConfig(), driven_joints(robot))

    @property
    def action_size(self) -> int:
        """Numbers of an action: fingers, arm, their other joints, then the grip's force."""
        return action_size(self.joints.at, self.config.action)

    def start(self, measured: Measured, targets: ThreePoints) -> CloserState:
        """The state at the handoff.

        Args:
            measured: At the handoff.
            targets: The contacts to close on.
        """
        at, batch = self.joints.at, measured.q.shape[:-1]
        fingers, joints = at.per_finger.shape
        no, zero = jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32)
        none = jnp.zeros((*batch, fingers), bool)
        return CloserState(
            tick=zero,
            start_pos=measured.pad_pos,
            goal_mat=goal_frame(measured.pad_mat, targets.normal),
            rest=measured.q,
            hold=measured.q[..., at.per_finger],
            residual=jnp.zeros((*batch, fingers * joints)),
            arm=measured.q[..., at.arm],
            observer=initial_observer(batch, len(at.grasping), fingers),
            observed=none,
            level=jnp.full(batch, self.config.grip.force, jnp.float32),
            trim=jnp.zeros(batch),
            least=jnp.zeros(batch),
            landed=none,
            grip_ticks=jnp.zeros((*batch, fingers), jnp.int32),
            lifting=no,
            lift_tick=zero,
            pressed=jnp.zeros(batch),
        )

    def tick(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        touching: Bool[Array, "*b f"],
        action: Float[Array, "*b k"],
    ) -> tuple[CloserState, Float[Array, "*b n"]]:
        """One control period.

        Args:
            state: From `start` or the last tick.
            measured: Now.
            targets: The contacts.
            touching: Contact flags from outside, all false if there are none.
            action: A policy's residuals in ±1; zeros for the model-based command alone.

        Returns:
            The state, and joint position targets in robot order [rad].
        """
        return self.act(self.sense(state, measured, targets, touching), measured, targets, action)

    def sense(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        touching: Bool[Array, "*b f"],
    ) -> CloserState:
        """Observer, landing, grip and stages after what was measured; arguments as in `tick`."""
        config, joints, at = self.config, self.joints, self.joints.at
        observer, observed = observe(
            state.observer,
            measured.external_torque,
            measured.q[..., at.grasping],
            measured.qd[..., at.grasping],
            joints.limits[at.grasping],
            joints.dry_friction,
            config.control_dt,
            config.observer,
        )
        touching = touching | observed
        begins = stages.lift_begins(touching, state.tick * config.control_dt, config.stages)
        lifting = state.lifting | begins
        landed = state.landed | touching
        there = self.there(state, measured, targets, landed, lifting)
        gripping = there | (state.grip_ticks > 0)
        state = state._replace(observer=observer)
        load = self.load(state, measured, targets)
        level = next_level(state.level, *load, config.control_dt, config.grip)
        force = jnp.mean(norm(self.forces(state, measured)), axis=-1)
        return state._replace(
            observed=observed,
            level=jnp.where(lifting, level, state.level),
            landed=landed,
            grip_ticks=jnp.where(gripping, state.grip_ticks + 1, 0),
            lifting=lifting,
            lift_tick=jnp.where(state.lifting, state.lift_tick + 1, 0),
            pressed=jnp.where(lifting, state.pressed + force, 0.0),
        )

    def act(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        action: Float[Array, "*b k"],
    ) -> tuple[CloserState, Float[Array, "*b n"]]:
        """Guided targets, grip force and scripted lift, plus the action; as in `tick`."""
        config, joints, at = self.config, self.joints, self.joints.at
        fingers, dt = len(at.fingers), config.control_dt
        jacobian = control.pad_jacobians(measured, at.per_finger)
        hold, residual = self.finger_targets(state, measured, targets, jacobian, action)
        share = stages.grip_share(state.grip_ticks * dt, config.grip)
        trim = control.update_trim(state.trim, action, config.action)
        state = state._replace(trim=trim)
        shares = finger_shares(hold.shape[-2], config.grip)
        force = self.grip_force(state)[..., None] * shares * share
        press = press_directions(measured.pad_pos, targets.position, targets.normal, config.grip)
        torque = control.grip_torques(jacobian, press, force)

        speed = jnp.where(state.lifting, self.lift_speed(state), 0.0)
        palm = control.palm_jacobian(measured, at.arm_policy)
        arm_rates = control.lift_rates(palm, speed, config.lift)
        arm_action = action[..., fingers : fingers + len(at.arm_policy)]
        if config.action.arm_settles:
            arm_action = jnp.where(self.lifted(state)[..., None], 0.0, arm_action)
        arm_rates = arm_rates + self.arm_rate(state) * arm_action
        moved = state.arm.at[..., at.arm_policy].add(arm_rates * dt)
        rest = state.rest
        if config.action.others:
            moved, rest = self._others(state, moved, rest, action)
        arm = jnp.clip(moved, *joints.limits[at.arm].T)

        guided = hold.reshape(residual.shape)
        target = guided + residual + torque.reshape(residual.shape) / joints.stiffness
        command = rest.at[..., at.arm].set(arm).at[..., at.fingers].set(target)
        after = state._replace(
            tick=state.tick + 1, hold=hold, residual=residual, arm=arm, rest=rest
        )
        return after, command

    def arm_rate(self, state: CloserState) -> Float[Array, "*b 1"] | float:
        """Speed of the arm's joints at action 1 [rad/s]."""
        return self.config.action.arm_rate

    def _others(
        self,
        state: CloserState,
        arm: Float[Array, "*b a"],
        rest: Float[Array, "*b n"],
        action: Float[Array, "*b k"],
    ) -> tuple[Float[Array, "*b a"], Float[Array, "*b n"]]:
        """Targets of arm and hand after the actions of the joints that closing leaves alone."""
        joints, at, dt = self.joints, self.joints.at, self.config.control_dt
        first = len(at.fingers) + len(at.arm_policy)
        own = action[..., first : first + len(at.others)]
        own = jnp.where(state.lifting[..., None], 0.0, own) * dt
        of_arm, fingers = len(at.other_arm), at.other_fingers
        arm = arm.at[..., at.other_arm].add(self.arm_rate(state) * own[..., :of_arm])
        moved = rest[..., fingers] + self.config.action.finger_rate * own[..., of_arm:]
        return arm, rest.at[..., fingers].set(jnp.clip(moved, *joints.limits[fingers].T))

    def there(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        landed: Bool[Array, "*b f"],
        lifting: Bool[Array, "*b"],
    ) -> Bool[Array, "*b f"]:
        """Which fingers are where they shall grip: landed, arrived, or late."""
        grip = self.config.grip
        left = self.way_left(state, measured, targets)
        limit = math.inf if grip.approach_s is None else grip.approach_s
        late = (state.tick - 1) * self.config.control_dt >= limit
        there = landed | (left < grip.arrival) | (late | lifting)[..., None]
        if grip.together:
            there = jnp.broadcast_to(there.all(axis=-1, keepdims=True), there.shape)
        return there

    def way_left(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Float[Array, "*b f"]:
        """How far each pad still has to go [m]."""
        return way_left(measured.pad_pos, state.start_pos, targets.position)

    def finger_targets(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        jacobian: Float[Array, "*b f 6 j"],
        action: Float[Array, "*b k"],
    ) -> tuple[Float[Array, "*b f j"], Float[Array, "*b m"]]:
        """Guided targets and the policy's share beside them, without the grip [rad]."""
        config, at, dt = self.config, self.joints.at, self.config.control_dt
        field = self.guidance(state, measured, targets)
        rates = control.guided_rates(jacobian, field, config.guidance)
        by_force = state.lifting[..., None] | (state.landed & config.grip.freezes)
        if config.grip.follow:  # a force brings a finger that has arrived short of the object to it
            by_force |= state.grip_ticks > 0
        q = measured.q[..., at.per_finger]
        hold = control.hold_until_landed(
            state.hold, q, rates, by_force, dt, config.guidance, self.follow(state)
        )
        own = action[..., : len(at.fingers)]
        return hold, control.update_residual(state.residual, own, dt, config.action)

    def guidance(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Float[Array, "*b f 6"]:
        """The field at the pads, world-aligned twists [m/s, rad/s]."""
        return guidance_field(
            measured.pad_pos,
            measured.pad_mat,
            state.start_pos,
            targets.position,
            self.goal(state, targets),
            self.config.guidance,
        )

    def goal(self, state: CloserState, targets: ThreePoints) -> Float[Array, "*b f 3 3"]:
        """R*, the pad frames at the contacts."""
        return state.goal_mat

    def follow(self, state: CloserState) -> Float[Array, "*b 1 1"] | float:
        """Share of the way to its joint that a held target goes in a tick."""
        grip = self.config.grip
        if not (grip.follow and grip.settles):
            return grip.follow
        return jnp.where(self.lifted(state), 0.0, grip.follow)[..., None, None]

    def lifted(self, state: CloserState) -> Bool[Array, "*b"]:
        """Whether the scripted lift is over."""
        return state.lift_tick * self.config.control_dt >= stages.lift_duration(self.config.lift)

    def grip_force(self, state: CloserState) -> Float[Array, "*b"]:
        """F as it is commanded: the level times the policy's factor, or the least if more [N]."""
        return jnp.maximum(state.level * self.config.action.grip_range**state.trim, state.least)

    def forces(self, state: CloserState, measured: Measured) -> Float[Array, "*b f 3"]:
        """Force of the object on each fingertip, estimated from joint torques [N], world frame.

        With `sticking` the dry friction of moving joints is known and left out; that of joints at
        rest may have either sign and stays in the estimate.
        """
        at, config, felt = self.joints.at, self.config.forces, self.away_from_stops(measured)
        torque = state.observer.torque
        if config.sticking is not None:
            speed = measured.qd[..., at.grasping] / config.sticking
            torque = torque + self.joints.dry_friction * jnp.tanh(speed)
        if config.joints == "moved":
            felt &= jnp.asarray(np.isin(at.grasping_per_finger, at.fingers))
        jacobian = control.pad_jacobians(measured, at.grasping_per_finger)
        return tip_forces(torque.reshape(felt.shape), jacobian, felt, config)

    def away_from_stops(self, measured: Measured) -> Bool[Array, "*b f k"]:
        """Which finger joints are so far from their stops that their torque is a contact's."""
        every, margin = self.joints.at.grasping_per_finger, self.config.observer.stop_margin
        q, limits = measured.q[..., every], self.joints.limits[every]
        return (q > limits[..., 0] + margin) & (q < limits[..., 1] - margin)

    def load(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> tuple[Float[Array, "*b f"], Float[Array, "*b f"]]:
        """What each fingertip bears, estimated: along its pressing direction and across [N]."""
        press = press_directions(
            measured.pad_pos, targets.position, targets.normal, self.config.grip
        )
        return pressing_and_sliding(self.forces(state, measured), press)

    def lift_speed(self, state: CloserState) -> Float[Array, "*b"]:
        """Speed of the scripted lift at this time since lift onset [m/s]."""
        return stages.lift_speed(state.lift_tick * self.config.control_dt, self.config.lift)
