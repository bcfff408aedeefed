"""What the policy sees: 66 proprioceptive numbers; and what only the critic may see."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.robot.spec import RobotSpec
from mjx_grasp.sim.physics import Readings

STACKED_STEPS = 2


def policy_sizes(robot: RobotSpec) -> tuple[int, int]:
    """How many numbers a policy of the robot reads, and with how many it answers."""
    fingers = len(robot.hand.policy_joints)
    actions = fingers + len(robot.arm.policy_joints)
    return STACKED_STEPS * (2 * fingers + actions), actions


def proprioception(
    q: Float[Array, "*b m"], qd: Float[Array, "*b m"], last_action: Float[Array, "*b a"]
) -> Float[Array, "*b d"]:
    """One step of the observation: finger positions [rad], velocities [rad/s], last action."""
    return jnp.concatenate([q, qd, last_action], axis=-1)


def privileged(
    proprio: Float[Array, "*b d"],
    readings: Readings,
    contacts: Float[Array, "*b f 3"],
    normals: Float[Array, "*b f 3"],
    landed: Bool[Array, "*b f"],
    lifting: Float[Array, "*b"],
    time: Float[Array, "*b"],
    lift_time: Float[Array, "*b"],
    rise: Float[Array, "*b"],
    displacement: Float[Array, "*b"],
    physics: Float[Array, "*b p"],
) -> Float[Array, "*b e"]:
    """The critic's observation in the default preset: the same, and what a simulator knows.

    Object pose and velocity, targets and pads relative to the palm, contact flags and forces,
    stage and time, friction and mass. The policy never sees it.
    """
    batch = proprio.shape[:-1]
    to_palm = jnp.swapaxes(readings.palm_mat, -1, -2)

    def in_palm(v: Array) -> Array:
        """Rotates world vectors [*b, n, 3] into the palm frame."""
        return jnp.sum(to_palm[..., None, :, :] * v[..., None, :], axis=-1)

    palm = readings.palm_pos[..., None, :]
    here = readings.object_pos[..., None, :]
    vectors = jnp.concatenate(
        [
            (here - palm) * 10.0,
            (contacts - readings.pad_pos) * 20.0,
            (readings.pad_pos - here) * 10.0,
            normals,
            readings.object_vel[..., None, :3],
            readings.tip_force * 0.2,
        ],
        axis=-2,
    )
    flat = in_palm(vectors).reshape(*batch, -1)
    scalars = jnp.stack([lifting, time, lift_time, rise * 10.0, displacement * 20.0], axis=-1)
    return jnp.concatenate(
        [
            proprio,
            flat,
            readings.object_quat,
            readings.object_vel[..., 3:] * 0.2,
            readings.tip_found.astype(jnp.float32),
            landed.astype(jnp.float32),
            scalars,
            physics,
        ],
        axis=-1,
    )
