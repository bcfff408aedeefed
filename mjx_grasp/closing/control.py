"""From a field and an action to joint position commands (method §5, the closing command)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.config import ActionConfig, GuidanceConfig, LiftConfig
from mjx_grasp.geometry.linear import damped_least_squares
from mjx_grasp.robot.indices import RobotIndices
from mjx_grasp.robot.interface import Measured


def point_jacobian(
    point: Float[Array, "*b 3"], axis: Float[Array, "*b j 3"], anchor: Float[Array, "*b j 3"]
) -> Float[Array, "*b 6 j"]:
    """World-aligned geometric Jacobian of a point: linear rows a × (p − o), angular rows a."""
    linear = jnp.cross(axis, point[..., None, :] - anchor)
    return jnp.swapaxes(jnp.concatenate([linear, axis], axis=-1), -1, -2)


def pad_jacobians(measured: Measured, joints: np.ndarray) -> Float[Array, "*b f 6 j"]:
    """Jacobians of the pads for joints [f, j] of each finger."""
    return point_jacobian(
        measured.pad_pos, measured.joint_axis[..., joints, :], measured.joint_anchor[..., joints, :]
    )


def pad_twists(measured: Measured, at: RobotIndices) -> Float[Array, "*b f 6"]:
    """Measured pad twists J q̇, arm and finger joints [m/s, rad/s]."""
    jacobian = pad_jacobians(measured, at.chains)
    return jnp.sum(jacobian * measured.qd[..., at.chains][..., None, :], axis=-1)


def palm_jacobian(measured: Measured, joints: np.ndarray) -> Float[Array, "*b 6 j"]:
    """Jacobian of the palm frame for arm joints [j]."""
    return point_jacobian(
        measured.palm_pos,
        measured.joint_axis[..., joints, :],
        measured.joint_anchor[..., joints, :],
    )


def guided_rates(
    jacobian: Float[Array, "*b f 6 j"], field: Float[Array, "*b f 6"], config: GuidanceConfig
) -> Float[Array, "*b f j"]:
    """Finger joint velocities that follow the field in the weighted least-squares sense [rad/s]."""
    angular = config.turn_weight**2
    weight = jnp.array([1.0, 1.0, 1.0, angular, angular, angular])
    rates = damped_least_squares(jacobian, field, weight, config.damping)
    return jnp.clip(rates, -config.rate_limit, config.rate_limit)


def grip_torques(
    jacobian: Float[Array, "*b f 6 j"],
    inward: Float[Array, "*b f 3"],
    force: Float[Array, "*b f"],
) -> Float[Array, "*b f j"]:
    """Jᵀ·F along unit vectors into the object [N m]."""
    return jnp.sum(jacobian[..., :3, :] * (force[..., None] * inward)[..., None], axis=-2)


def lift_rates(
    jacobian: Float[Array, "*b 6 j"], speed: Float[Array, "*b"], config: LiftConfig
) -> Float[Array, "*b j"]:
    """Arm joint velocities that raise the palm without turning it [rad/s]."""
    zero = jnp.zeros_like(speed)
    twist = jnp.stack([zero, zero, speed, zero, zero, zero], axis=-1)
    return damped_least_squares(jacobian, twist, jnp.ones(6), config.damping)


def update_residual(
    residual: Float[Array, "*b m"], action: Float[Array, "*b m"], dt: float, config: ActionConfig
) -> Float[Array, "*b m"]:
    """The finger residual after an action [rad]: a bounded leak, or the published integral."""
    step = config.finger_rate * dt * action
    if config.residual == "integrated":
        return residual + step
    kept = config.keep * residual + step
    return jnp.clip(kept, -config.limit, config.limit)


def update_trim(
    trim: Float[Array, "*b"], action: Float[Array, "*b k"], config: ActionConfig
) -> Float[Array, "*b"]:
    """The policy's share in the grip's force after an action, in ±1; its last number says it."""
    if not config.of_grip:
        return trim
    return config.keep * trim + (1.0 - config.keep) * jnp.clip(action[..., -1], -1.0, 1.0)


def hold_until_landed(
    hold: Float[Array, "*b f j"],
    q: Float[Array, "*b f j"],
    rates: Float[Array, "*b f j"],
    landed: Bool[Array, "*b f"],
    dt: float,
    config: GuidanceConfig,
    follow: Float[Array, "*b 1 1"] | float = 0.0,
) -> Float[Array, "*b f j"]:
    """Guided joint targets [rad]: they follow the field until the finger lands.

    Then they stay, or go by the share `follow` of the way to the joint every tick.
    """
    lead = jnp.clip(hold + rates * dt - q, -config.lead, config.lead)
    kept = hold + follow * (q - hold)
    return jnp.where(landed[..., None], kept, q + lead)
