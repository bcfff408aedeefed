"""Vectors as three arrays, x, y and z, so that all that is done with them fuses into one pass."""

from __future__ import annotations

from jaxtyping import Array, Float

Scalars = Float[Array, "*#n"]
"""One number for each of n items, or a number for all along some of their axes."""
Components = tuple[Scalars, ...]
"""x, y and z."""


def components(x: Float[Array, "*n 3"]) -> Components:
    """Vectors along the last axis, taken apart."""
    return x[..., 0], x[..., 1], x[..., 2]


def dot(a: Components, b: Components) -> Scalars:
    """Inner products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Components, b: Components) -> Components:
    """Cross products."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
