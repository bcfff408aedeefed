"""Draws the parametric stand-ins that are shipped, as `stand_ins.yaml` beside this says.

  python experiments/stand_ins.py

Start states know the object they are for by its mesh: where a stand-in changes, those of it have to
be made again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
import yaml
from shapes import (
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

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.objects.meshes import centred
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import CommandSettings

_VERTICES = 2000
"""About how many vertices a stand-in gets."""
_PLACE = ("at", "axis", "degrees")


@dataclass(frozen=True)
class StandInsConfig(CommandSettings):
    """Draws the stand-ins of all objects."""

    out: Path | None = None
    """where to write (.npz); over the shipped file by default"""


def main(config: StandInsConfig) -> None:
    """The command."""
    path = config.out or asset_path("stand_ins.npz")
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays_of(drawn()))
    print(f"written: {path}")


def drawn() -> dict[str, trimesh.Trimesh]:
    """Every stand-in in its object frame [m], axis-aligned box centred at the origin."""
    described = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
    return {name: centred(_drawn(part)) for name, part in described.items()}


def arrays_of(meshes: Mapping[str, trimesh.Trimesh]) -> dict[str, Any]:
    """The meshes as the file holds them, see `mjx_grasp/objects/parametric.py`."""
    arrays: dict[str, Any] = {}
    for name, mesh in meshes.items():
        arrays[f"{name}.vertices"] = np.asarray(mesh.vertices, np.float64)
        arrays[f"{name}.faces"] = np.asarray(mesh.faces, np.uint16)
    return arrays


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


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(StandInsConfig, description=__doc__)))
