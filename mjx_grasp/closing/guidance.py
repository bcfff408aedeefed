"""The guidance vector field that brings each pad from its handoff position to its contact."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.closing.config import GuidanceConfig
from mjx_grasp.geometry import so3


def guidance_field(
    x: Float[Array, "*b 3"],
    mat: Float[Array, "*b 3 3"],
    start: Float[Array, "*b 3"],
    goal: Float[Array, "*b 3"],
    goal_mat: Float[Array, "*b 3 3"],
    config: GuidanceConfig,
) -> Float[Array, "*b 6"]:
    """World-aligned twist at the pad: linear [m/s], then angular [rad/s] (method §5).

    v = v_max·min(1, ρ/ε_p)·d + η(x_c − x) along the line from `start` to `goal`, with ρ the way
    left along it and x_c the nearest point on it; ω = k_R·log(R* Rᵀ).

    Args:
        x: Pad positions [m].
        mat: Pad frames.
        start: Pad positions at the handoff [m].
        goal: Contacts on the object [m].
        goal_mat: R*, the pad frame at the contact.
        config: Gains.
    """
    way = goal - start
    length = jnp.sqrt(jnp.sum(way**2, -1, keepdims=True) + 1e-12)
    d = way / length
    s = jnp.clip(jnp.sum((x - start) * d, -1, keepdims=True), 0.0, length)
    speed = config.speed * jnp.minimum(1.0, (length - s) / config.slowdown)
    linear = speed * d + config.return_rate * (start + s * d - x)
    turn = jnp.sum(goal_mat[..., :, None, :] * mat[..., None, :, :], axis=-1)
    return jnp.concatenate([linear, config.turn_rate * so3.log(turn)], axis=-1)


def way_left(
    x: Float[Array, "*b 3"], start: Float[Array, "*b 3"], goal: Float[Array, "*b 3"]
) -> Float[Array, "*b"]:
    """ρ: the way left along the line from `start` to `goal` [m], 0 beyond its end."""
    way = goal - start
    length = jnp.sqrt(jnp.sum(way**2, -1) + 1e-12)
    s = jnp.sum((x - start) * way, -1) / length
    return length - jnp.clip(s, 0.0, length)


def goal_frame(
    mat: Float[Array, "*b 3 3"], outward_normal: Float[Array, "*b 3"]
) -> Float[Array, "*b 3 3"]:
    """R*: the pad frame turned by the least rotation that points its normal into the surface.

    Args:
        mat: Pad frames at the handoff; the first column is the pad's normal.
        outward_normal: Outward unit normals at the contacts.
    """
    rotation = so3.align_vectors(mat[..., :, 0], -outward_normal)
    return jnp.sum(rotation[..., :, :, None] * mat[..., None, :, :], axis=-2)


def twist_norm(twist: Float[Array, "*b 6"], angular_weight: float) -> Float[Array, "*b"]:
    """‖e‖_w = √(|lin|² + (w·|ang|)²) [m/s] (method §5)."""
    linear, angular = twist[..., :3], twist[..., 3:]
    return jnp.sqrt(jnp.sum(linear**2, -1) + angular_weight**2 * jnp.sum(angular**2, -1) + 1e-12)
