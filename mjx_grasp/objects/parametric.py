"""Parametric stand-ins for all objects of the catalogue, drawn as ``stand_ins.yaml`` says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import trimesh
import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.objects.meshes import centred
from mjx_grasp.objects.shapes import (
    arc,
    capsule,
    ellipsoid,
    joined,
    lathe,
    loft,
    rounded_box,
    set_at,
    smooth,
    swept,
)

_VERTICES = 2000
"""About how many vertices a stand-in gets."""
_PLACE = ("at", "axis", "degrees")


def stand_in(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """The stand-in of an object in its object frame [m], axis-aligned box centred at the origin.

    Args:
        name: The object's name without a suffix for its scale.
        scale: Uniform scale.

    Raises:
        InputError: There is no stand-in of this name.
    """
    known = _described()
    if name not in known:
        raise InputError("object", name, f"one of {', '.join(sorted(known))}")
    return centred(_drawn(known[name]), scale)


@cache
def _described() -> dict[str, dict[str, Any]]:
    """The parts of every stand-in."""
    return yaml.safe_load(asset_path("stand_ins.yaml").read_text())


def _drawn(part: Mapping[str, Any]) -> trimesh.Trimesh:
    """A part, or several as one, where it says."""
    place = {key: part[key] for key in _PLACE if key in part}
    ((kind, sizes),) = ((key, value) for key, value in part.items() if key not in place)
    mesh = joined(*map(_drawn, sizes)) if kind == "parts" else _SHAPES[kind](**sizes)
    return set_at(mesh, **place) if place else mesh


def _edge(extents: Sequence[float]) -> float:
    """Edge length that gives a box of these extents about `_VERTICES` vertices [m]."""
    x, y, z = extents
    return float(np.sqrt(2.0 * (x * y + y * z + z * x) / _VERTICES))


def _box(
    extents: Sequence[float], radius: float = 0.003, edge: float | None = None
) -> trimesh.Trimesh:
    return rounded_box(extents, radius, edge or _edge(extents))


def _can(radius: float, height: float, rim: float = 0.0015) -> trimesh.Trimesh:
    """A closed can with rounded rims."""
    bottom = arc((radius - rim, rim), rim, -90, 0)
    top = arc((radius - rim, height - rim), rim, 0, 90)
    profile = np.concatenate([[[0.0, 0.0]], bottom, top, [[0.0, height]]])
    return lathe(profile, _edge((2 * radius, 2 * radius, height)))


def _tube(
    points: Sequence[Sequence[float]],
    half_across: float,
    edge: float,
    half_up: float | None = None,
    count: int = 24,
    **options: Any,
) -> trimesh.Trimesh:
    """A section swept along a smooth curve through points; as high as it is wide by default."""
    return swept(smooth(points, count), half_across, half_up or half_across, edge, **options)


def _banana() -> trimesh.Trimesh:
    angle = np.radians(np.linspace(-52, 52, 25))
    path = np.stack([0.125 * np.sin(angle), 0.125 * np.cos(angle), 0 * angle], axis=1)
    along = np.abs(np.linspace(-1, 1, 25))
    radius = 0.018 * np.sqrt(np.maximum(1.0 - along**4, 0.03))
    return swept(path, radius, radius, 0.0042)


def _pear() -> trimesh.Trimesh:
    z = np.linspace(0.0, np.pi, 25)
    height = 0.05 * (1 - np.cos(z))
    radius = np.sin(z) * (0.0331 - 0.012 * (height / 0.1 - 0.25))
    radius *= 0.0331 / radius.max()
    upright = lathe(np.column_stack([radius, height]), 0.0042)
    return set_at(upright, axis=(0.0, 1.0, 0.0), degrees=90.0)


_SHAPES: dict[str, Callable[..., trimesh.Trimesh]] = {
    "ball": lambda radius: ellipsoid((radius, radius, radius)),
    "banana": _banana,
    "box": _box,
    "can": _can,
    "capsule": capsule,
    "ellipsoid": ellipsoid,
    "lathe": lathe,
    "loft": loft,
    "pear": _pear,
    "tube": _tube,
}
