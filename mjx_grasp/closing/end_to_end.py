"""The closing controller under a policy that reaches as well: end to end (method §6)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.closer import Closer, CloserState
from mjx_grasp.closing.guidance import goal_frame
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.interface import Measured


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class EndToEndCloser(Closer):
    """A `Closer` that starts anywhere and whose contacts may move; static under jit.

    Before the lift a policy moves the arm and, where it is not assisted, the fingers alone: its
    finger velocities move the held targets within the joints' limits. Without assistance the grip
    waits for the lift, too. Stages, grip and lift are the `Closer`'s.
    """

    assisted: bool = False
    """whether guidance and grip act before the lift too, and the actions are added to them"""
    within: float = math.inf
    """mean distance of the pads from their contacts within which guidance does, each then straight
    at its own [m]; inf: anywhere, along the lines on which the episode began"""
    reach_rate: float | None = None
    """speed of the arm's joints at action 1 before the lift; None: as in it [rad/s]"""

    def arm_rate(self, state: CloserState) -> Float[Array, "*b 1"] | float:
        """Speed of the arm's joints at action 1 [rad/s]."""
        if self.reach_rate is None:
            return super().arm_rate(state)
        rates = self.config.action.arm_rate, self.reach_rate
        return jnp.where(state.lifting[..., None], *rates)

    def guidance(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Float[Array, "*b f 6"]:
        """The field at the pads, world-aligned twists [m/s, rad/s]."""
        if math.isinf(self.within):
            return super().guidance(state, measured, targets)
        # A line from where the episode began may go through the object.
        field = super().guidance(state._replace(start_pos=measured.pad_pos), measured, targets)
        return jnp.where(self.near(state, measured, targets)[..., None, None], field, 0.0)

    def goal(self, state: CloserState, targets: ThreePoints) -> Float[Array, "*b f 3 3"]:
        """The pad frames where the contacts are now."""
        return goal_frame(state.goal_mat, targets.normal)

    def way_left(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Float[Array, "*b f"]:
        """The distance to the contact [m]: a pad that nothing guides passes it by."""
        return norm(targets.position - measured.pad_pos)

    def there(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        landed: Bool[Array, "*b f"],
        lifting: Bool[Array, "*b"],
    ) -> Bool[Array, "*b f"]:
        """Which fingers shall grip: all in the lift; those that are there too, if assisted."""
        if self.assisted:
            return super().there(state, measured, targets, landed, lifting)
        return jnp.broadcast_to(lifting[..., None], landed.shape)

    def finger_targets(
        self,
        state: CloserState,
        measured: Measured,
        targets: ThreePoints,
        jacobian: Float[Array, "*b f 6 j"],
        action: Float[Array, "*b k"],
    ) -> tuple[Float[Array, "*b f j"], Float[Array, "*b m"]]:
        """Targets that the actions move, and those of the `Closer` where it acts [rad]."""
        hold, residual = super().finger_targets(state, measured, targets, jacobian, action)
        config, at = self.config, self.joints.at
        step = config.action.finger_rate * config.control_dt * action[..., : len(at.fingers)]
        limits = self.joints.limits[at.per_finger]
        moved = state.hold + step.reshape(state.hold.shape)
        moved = jnp.clip(moved, limits[..., 0], limits[..., 1])
        alone = ~self.helped(state, measured, targets)[..., None]
        return (
            jnp.where(alone[..., None], moved, hold),
            jnp.where(alone, state.residual, residual),
        )

    def helped(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Bool[Array, "*b"]:
        """Whether the `Closer` moves the fingers, and actions are added: in the lift, or near."""
        if not self.assisted:
            return state.lifting
        return state.lifting | self.near(state, measured, targets)

    def near(
        self, state: CloserState, measured: Measured, targets: ThreePoints
    ) -> Bool[Array, "*b"]:
        """Whether the pads are so near to their contacts that guidance acts."""
        return jnp.mean(self.way_left(state, measured, targets), axis=-1) < self.within
