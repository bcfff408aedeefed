"""The closing controller under a policy that reaches as well: end to end (method §6)."""

from __future__ import annotations

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

    Before the lift a policy moves the arm and, unless it is assisted, the fingers alone: its finger
    velocities move the held targets within the joints' limits, and the grip waits for the lift.
    Stages, grip and lift are the `Closer`'s.
    """

    assisted: bool = False
    """whether guidance and grip act before the lift too, and the actions are added to them"""

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
        """Targets that the actions move, then in the lift those of the `Closer` [rad]."""
        hold, residual = super().finger_targets(state, measured, targets, jacobian, action)
        if self.assisted:
            return hold, residual
        config, at = self.config, self.joints.at
        step = config.action.finger_rate * config.control_dt * action[..., : len(at.fingers)]
        limits = self.joints.limits[at.per_finger]
        moved = state.hold + step.reshape(state.hold.shape)
        moved = jnp.clip(moved, limits[..., 0], limits[..., 1])
        lifting = state.lifting[..., None]
        return (
            jnp.where(lifting[..., None], hold, moved),
            jnp.where(lifting, residual, state.residual),
        )
