"""How many numbers the policy sees, 66 or more, and what only the critic may see."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.joints import action_size
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.indices import robot_indices
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Truth
from mjx_grasp.tasks.config import ClosingTaskConfig


def policy_sizes(robot: RobotSpec, config: ClosingTaskConfig) -> tuple[int, int]:
    """How many numbers a policy of the task reads, and with how many it answers."""
    joints, fingers, arm = (
        len(part) for part in (robot.hand.policy_joints, robot.hand.fingers, robot.arm.joints)
    )
    at, seen = robot_indices(robot), config.observation
    actions = action_size(at, config.action)
    step = 2 * joints + actions + seen.forces * (2 * fingers + 1)
    step += (seen.targets + seen.normals) * 3 * fingers + seen.arm * arm
    step += seen.others * len(at.others)
    known = _SCALARS + 2 * seen.forces + 3 * (2 + 4 * fingers) + 7 + 2 * fingers
    return len(seen.ticks_ago) * step + seen.budget + seen.truth * known, actions


_SCALARS = 7
"""Of `privileged`, of a task that feels no forces."""


def privileged(
    proprio: Float[Array, "*b d"],
    measured: Measured,
    truth: Truth,
    targets: ThreePoints,
    landed: Bool[Array, "*b f"],
    scalars: tuple[Float[Array, "*b"], ...],
) -> Float[Array, "*b e"]:
    """The critic's observation in the default preset: the same, and what a simulator knows.

    Object pose and velocity, targets and pads relative to the palm, contact flags and forces. The
    policy never sees it, but where `ObservationConfig.truth` says so.

    Args:
        proprio: The policy's observation.
        measured: The robot.
        truth: The rest of the world.
        targets: The contacts.
        landed: Which fingers have ever touched.
        scalars: Further numbers, already of the size of 1: stage, times, friction and so on.
    """
    batch = proprio.shape[:-1]
    to_palm = jnp.swapaxes(measured.palm_mat, -1, -2)

    def in_palm(v: Float[Array, "*b n 3"]) -> Float[Array, "*b n 3"]:
        """World vectors in the palm frame."""
        return jnp.sum(to_palm[..., None, :, :] * v[..., None, :], axis=-1)

    palm = measured.palm_pos[..., None, :]
    here = truth.object_pos[..., None, :]
    vectors = jnp.concatenate(
        [
            (here - palm) * 10.0,
            (targets.position - measured.pad_pos) * 20.0,
            (measured.pad_pos - here) * 10.0,
            targets.normal,
            truth.object_vel[..., None, :3],
            truth.tip_force * 0.2,
        ],
        axis=-2,
    )
    return jnp.concatenate(
        [
            proprio,
            in_palm(vectors).reshape(*batch, -1),
            truth.object_quat,
            truth.object_vel[..., 3:] * 0.2,
            truth.tip_found.astype(jnp.float32),
            landed.astype(jnp.float32),
            jnp.stack(scalars, axis=-1),
        ],
        axis=-1,
    )
