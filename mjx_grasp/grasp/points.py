"""The three-point interface: all that reaching and closing know of a grasp."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float


class ThreePoints(NamedTuple):
    """Where thumb, first and second wrap are to touch the object; world frame."""

    position: Float[Array, "*b 3 3"]
    """contacts on the surface [m]"""
    normal: Float[Array, "*b 3 3"]
    """outward unit normals there"""
