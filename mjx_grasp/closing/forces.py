"""Forces of the fingertips from joint torques, and how hard a grip has to press (method §5)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.config import ForceConfig, GripConfig
from mjx_grasp.geometry.linear import solve_spd
from mjx_grasp.grasp.levered import across_thin_wall

_OPPOSITE = 0.5  # least cosine between a normal and the line to the other side


def tip_forces(
    torque: Float[Array, "*b f j"],
    jacobian: Float[Array, "*b f 6 j"],
    felt: Bool[Array, "*b f j"],
    config: ForceConfig,
) -> Float[Array, "*b f 3"]:
    """Force of the object on each pad, f̂ = J⁻ᵀ τ̂ [N], world frame.

    argmin_f Σ_j w_j (Jᵀ f − τ̂)_j² + λ²|f|². The damping λ, a length, bounds the estimate where the
    finger is stretched or folded; joints at a stop have no weight, for nobody can tell the stop's
    torque from a contact's.

    Args:
        torque: τ̂, external torque on each finger's joints [N m].
        jacobian: Of the pads for these joints.
        felt: Which joints have a torque sensor and are away from their stops.
        config: λ and bound.
    """
    linear = jacobian[..., :3, :]
    weighted = linear * felt[..., None, :]
    normal = jnp.sum(weighted[..., :, None, :] * linear[..., None, :, :], axis=-1)
    normal = normal + config.damping**2 * jnp.eye(3)
    force = solve_spd(normal, jnp.sum(weighted * torque[..., None, :], axis=-1))
    size = jnp.sqrt(jnp.sum(force**2, axis=-1, keepdims=True) + 1e-12)
    return force * jnp.minimum(1.0, config.most / size)


def press_directions(
    pads: Float[Array, "*b f 3"],
    contacts: Float[Array, "*b f 3"],
    normals: Float[Array, "*b f 3"],
    config: GripConfig,
) -> Float[Array, "*b f 3"]:
    """Unit vectors along which the fingers press.

    Against the contacts' normals; or along the line between the thumb's pad and the middle of the
    others, on which the thumb's force and theirs cancel. Not where thumb and others grip a thin
    wall at different heights: forces along one line make no couple, which is what those are for.

    Args:
        pads: Pad positions, the thumb's first [m].
        contacts: The contacts, in the same order [m].
        normals: Outward unit normals there.
        config: Which of the two.
    """
    if config.direction == "normals":
        return -normals
    sign = jnp.where(jnp.arange(pads.shape[-2]) == 0, 1.0, -1.0)[:, None]
    line = sign * _thumb_to_others(pads)[..., None, :]
    across = sign * _thumb_to_others(contacts)[..., None, :]
    beside = jnp.any(jnp.sum(across * normals, axis=-1) > -_OPPOSITE, axis=-1)
    levered = beside & across_thin_wall(contacts)
    return jnp.where(levered[..., None, None], -normals, line)


def _thumb_to_others(points: Float[Array, "*b f 3"]) -> Float[Array, "*b 3"]:
    line = jnp.mean(points[..., 1:, :], axis=-2) - points[..., 0, :]
    return line / jnp.sqrt(jnp.sum(line**2, axis=-1, keepdims=True) + 1e-12)


def finger_shares(fingers: int, config: GripConfig) -> Float[np.ndarray, " f"]:
    """Each finger's share of the grip's force; their mean is 1."""
    if config.split == "even":
        return np.ones(fingers, np.float32)
    # The thumb bears what the others bear together.
    return np.array([fingers / 2, *[fingers / 2 / (fingers - 1)] * (fingers - 1)], np.float32)


def pressing_and_sliding(
    force: Float[Array, "*b f 3"], press: Float[Array, "*b f 3"]
) -> tuple[Float[Array, "*b f"], Float[Array, "*b f"]]:
    """Each finger's force against the direction in which it presses, and across it [N].

    Args:
        force: Of the object on the fingers.
        press: Unit vectors, `press_directions`.
    """
    along = -jnp.sum(force * press, axis=-1)
    across = force + along[..., None] * press
    return jnp.maximum(along, 0.0), jnp.sqrt(jnp.sum(across**2, axis=-1) + 1e-12)


def next_level(
    level: Float[Array, "*b"],
    normal: Float[Array, "*b f"],
    tangential: Float[Array, "*b f"],
    dt: float,
    config: GripConfig,
) -> Float[Array, "*b"]:
    """The grip's force per finger after a tick of load [N].

    It goes by what is missing to hold the load at friction μ₀, (Σ t / μ₀ − Σ n) / fingers, not
    faster than the rates and not beyond floor and ceiling.

    Args:
        level: Before [N].
        normal: n, with which each finger presses [N].
        tangential: t, across [N].
        dt: Control period [s].
        config: μ₀, bounds and rates.
    """
    if config.friction is None:
        return level
    missing = jnp.mean(tangential / config.friction - normal, axis=-1)
    change = jnp.clip(missing, -config.fall * dt, config.rise * dt)
    return jnp.clip(level + change, config.force, max(config.force, config.most))
