"""Nearest points of two line segments, for capsules against capsules."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import dot

_TINY = 1e-12


def closest_between_segments(
    a0: Float[Array, "*#n 3"],
    a1: Float[Array, "*#n 3"],
    b0: Float[Array, "*#n 3"],
    b1: Float[Array, "*#n 3"],
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """The nearest point on each of two segments, [m]; exact, also where they are parallel.

    The minimum of the two lines, clipped to the first segment, then alternately projected: two
    projections reach the minimum of the convex quadratic over the square of parameters.
    """
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, vv, uv = dot(u, u), dot(v, v), dot(u, v)
    uw, vw = dot(u, w), dot(v, w)
    uu_safe, vv_safe = jnp.maximum(uu, _TINY), jnp.maximum(vv, _TINY)
    cross = uu * vv - uv * uv
    parallel = cross <= 1e-6 * uu_safe * vv_safe
    s = jnp.where(parallel, 0.5, (uv * vw - vv * uw) / jnp.where(parallel, 1.0, cross))
    s = jnp.clip(s, 0.0, 1.0)
    t = jnp.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    s = jnp.clip((uv * t - uw) / uu_safe, 0.0, 1.0)
    t = jnp.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    return a0 + s[..., None] * u, b0 + t[..., None] * v
