"""Small vector laws that stay finite on zero vectors."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def unit(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """``v / |v|``; a vector too short to have a direction stays zero instead of becoming NaN."""
    # Scaling by the largest entry first keeps the squares of tiny (area-weighted) vectors normal.
    largest = jnp.max(jnp.abs(v), axis=-1, keepdims=True)
    scaled = v / jnp.where(largest > 0, largest, 1.0)
    length = jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))
    return jnp.where(largest > 0, scaled / jnp.where(length > 0, length, 1.0), 0.0)


def angle_between(
    a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]
) -> Float[Array, "*batch"]:
    """Angle between two vectors in [rad], in [0, π]; accurate near 0 and π, 0 for zero vectors."""
    cross = jnp.cross(a, b)
    sine = jnp.sqrt(jnp.sum(cross * cross, axis=-1))
    return jnp.arctan2(sine, jnp.sum(a * b, axis=-1))


def distance_to_line(
    point: Float[Array, "*batch 3"],
    origin: Float[Array, "*batch 3"],
    direction: Float[Array, "*batch 3"],
) -> Float[Array, "*batch"]:
    """Distance in [m] from ``point`` to the line through ``origin`` along the unit ``direction``.

    ``d⊥ = |r − (rᵀg)g|`` with ``r = point − origin`` (method §1, steering).
    """
    r = point - origin
    off = r - jnp.sum(r * direction, axis=-1, keepdims=True) * direction
    return jnp.sqrt(jnp.sum(off * off, axis=-1))
