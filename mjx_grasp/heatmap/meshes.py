"""Heatmaps of a user's own meshes: what every command on them is asked for, and the heatmap."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Float

from mjx_grasp.geometry.mesh import principal_frame
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.files import HeatmapInfo, StoredHeatmap
from mjx_grasp.heatmap.steering import Steering, steer_to
from mjx_grasp.records.settings import CommandSettings, Finite, Positive, Several
from mjx_grasp.robot.spec import load_robot


def numbers(count: int, metavar: str) -> tyro.constructors.PrimitiveConstructorSpec:
    """How so many numbers, or none of them, are read from a command line; part of a type."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=count,
        metavar=metavar,
        instance_from_str=lambda words: tuple(map(float, words)),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["None"] if value is None else [*map(str, value)],
    )


Point = Annotated[tuple[Finite, Finite, Finite] | None, numbers(3, "X Y Z")]
Span = Annotated[
    Annotated[tuple[Positive, Positive], Several(ascending=True, strictly=True)] | None,
    numbers(2, "MIN MAX"),
]


@dataclass(frozen=True)
class MeshConfig(CommandSettings):
    """A mesh in metres, the hand that is to grasp it, and where."""

    mesh: tyro.conf.Positional[Path]
    """the mesh [m]"""
    anchor: Point = None
    """point that grasps are steered to, in the frame of the mesh; none without one [m]"""
    steering: Steering = "contacts"
    """what has to be near the anchor: all three contacts, the grasp's axis (the publication's
    formula), or the middle of the grasp, between the contacts"""
    sigma: Positive | None = None
    """distance from the anchor at which a score falls to 1/e; by default 0.03, or as a named part
    is large [m]"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot whose hand grasps"""
    span: Span = None
    """narrowest and widest grasp; the hand's by default [m]"""
    friction: Positive | None = None
    """scoring friction; the hand's by default [-]"""
    heatmap: HeatmapConfig = field(default_factory=HeatmapConfig)

    def grip(self) -> tuple[tuple[float, float], float]:
        """Span [m] and scoring friction [-], as asked for or of the robot's hand."""
        if self.span is not None and self.friction is not None:
            return self.span, self.friction
        hand = load_robot(self.robot).hand
        return self.span or hand.span, self.friction or hand.scoring_friction


def heatmap_of_mesh(
    name: str,
    mesh: trimesh.Trimesh,
    grip: tuple[tuple[float, float], float],
    config: HeatmapConfig | None = None,
) -> StoredHeatmap:
    """The heatmap of a mesh at uniform density, as it is kept in files.

    Its vertices and faces are those of the mesh refined, see :func:`..compute.heatmap_surface`.

    Args:
        name: Of the mesh.
        mesh: In [m].
        grip: Span [m] and scoring friction [-] of the hand.
        config: Settings of the heatmap; the defaults if None.
    """
    surface = heatmap_surface(mesh, config)
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    heatmap = jax.tree.map(np.asarray, compute_heatmap(vertices, faces, None, *grip, config))
    com = _point(principal_frame(vertices, faces).centre)
    return StoredHeatmap(heatmap, faces, HeatmapInfo(name, *grip, com))


def steered(
    stored: StoredHeatmap,
    anchor: Float[np.ndarray, " 3"],
    size: Float[np.ndarray, " 3"] | None = None,
    sigma: float | None = None,
    steering: Steering = "contacts",
) -> StoredHeatmap:
    """A heatmap with its scores steered to an anchor; see `steer_to`."""
    score = steer_to(stored.heatmap, jnp.asarray(anchor), size, sigma, steering)
    heatmap = jax.tree.map(np.asarray, stored.heatmap._replace(score=score))
    info = replace(
        stored.info,
        anchor=_point(anchor),
        sigma=sigma,
        steering=steering,
        size=None if size is None or not np.any(size) else _point(size),
    )
    return replace(stored, heatmap=heatmap, info=info)


def _point(values: Float[np.ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
