"""Small vector laws that stay finite on zero vectors.

Sums over three components are written out: they fuse with what surrounds them, and jaxlib 0.10.2
returns wrong numbers on the CPU for some fused reductions of more than 32,768 results
(github.com/jax-ml/jax, issue 39103).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def dot(a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]) -> Float[Array, "*batch"]:
    """Inner product of 3-vectors."""
    parts = a * b
    return parts[..., 0] + parts[..., 1] + parts[..., 2]


def norm(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Length of 3-vectors."""
    return jnp.sqrt(dot(v, v))


def unit(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """``v / |v|``; a vector too short to have a direction stays zero instead of becoming NaN."""
    # Scaling by the largest entry first keeps the squares of tiny (area-weighted) vectors normal.
    largest = jnp.maximum(jnp.maximum(jnp.abs(v[..., 0]), jnp.abs(v[..., 1])), jnp.abs(v[..., 2]))[
        ..., None
    ]
    scaled = v / jnp.where(largest > 0, largest, 1.0)
    length = norm(scaled)[..., None]
    return jnp.where(largest > 0, scaled / jnp.where(length > 0, length, 1.0), 0.0)


def turned(
    R: Float[Array, "*#batch 3 3"], v: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3"]:
    """``R v``: vectors of a frame, given by its rotation, in that which it is rotated in."""
    parts = R * v[..., None, :]
    return parts[..., 0] + parts[..., 1] + parts[..., 2]


def turned_back(
    R: Float[Array, "*#batch 3 3"], v: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3"]:
    """``Rᵀ v``: the way back of :func:`turned`."""
    parts = R * v[..., :, None]
    return parts[..., 0, :] + parts[..., 1, :] + parts[..., 2, :]


def angle_between(
    a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch"]:
    """Angle between two vectors in [rad], in [0, π]; accurate near 0 and π, 0 for zero vectors."""
    return jnp.arctan2(norm(jnp.cross(a, b)), dot(a, b))


def distance_to_line(
    point: Float[Array, "*#batch 3"],
    origin: Float[Array, "*#batch 3"],
    direction: Float[Array, "*#batch 3"],
) -> Float[Array, "*batch"]:
    """Distance in [m] from ``point`` to the line through ``origin`` along the unit ``direction``.

    ``d⊥ = |r − (rᵀg)g|`` with ``r = point − origin`` (method §1, steering).
    """
    r = point - origin
    return norm(r - dot(r, direction)[..., None] * direction)
