"""The shapes of a robot's MJCF as spheres swept along segments, and spheres that fill them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import InputError

# Spheres that cover a box cut its corners by 0.73 of their radius at most, [m].
_BOX_SPHERE_RADIUS = 0.008
# Points within a cube of this edge share a constraint, [m].
_CELL = 0.020


@dataclass(frozen=True, eq=False)
class Solids:
    """Spheres swept along segments that are fixed to frames; a point has no length.

    The members of a group share constraints: one for the nearest point of all, and for segments
    one more for the nearest of either end. With the nearest point alone, a link beside a surface
    could rock: while one end is held back, a turn takes the other one in unchecked.
    """

    frame: Int[np.ndarray, " n"]
    start: Float[np.ndarray, "n 3"]
    """in the frame [m]"""
    end: Float[np.ndarray, "n 3"]
    """in the frame [m]"""
    radius: Float[np.ndarray, " n"]
    """[m]"""
    groups: Int[np.ndarray, "g k"]
    """members, padded by repetition"""
    names: tuple[str, ...]
    """of the groups"""

    @property
    def are_points(self) -> bool:
        """Whether no segment has a length."""
        return np.array_equal(self.start, self.end)

    @property
    def rows(self) -> int:
        """How many constraints they get against object or obstacles."""
        return len(self.groups) * (1 if self.are_points else 3)


def merged(parts: Sequence[Solids]) -> Solids:
    """Several sets of solids as one, with all their groups."""
    firsts = np.cumsum([0, *(len(solids.frame) for solids in parts[:-1])])
    groups = [list(g + n) for n, solids in zip(firsts, parts, strict=True) for g in solids.groups]
    return Solids(
        frame=np.concatenate([solids.frame for solids in parts]),
        start=np.concatenate([solids.start for solids in parts]),
        end=np.concatenate([solids.end for solids in parts]),
        radius=np.concatenate([solids.radius for solids in parts]),
        groups=padded(groups),
        names=tuple(name for solids in parts for name in solids.names),
    )


@dataclass(frozen=True)
class Part:
    """A sphere swept along a segment of a body."""

    body: int
    start: Float[np.ndarray, " 3"]
    """in the body's frame [m]"""
    end: Float[np.ndarray, " 3"]
    """in the body's frame [m]"""
    radius: float
    """[m]"""


def covered(model: mujoco.MjModel, body: int) -> list[Part]:
    """A body's round shapes, and small spheres just inside the surface of its boxes.

    Raises:
        InputError: It has a shape that is neither capsule, sphere, box nor cylinder.
    """
    parts = _round(model, body)
    for geom in _boxes(model, body):
        size = model.geom_size[geom]
        radius = min(_BOX_SPHERE_RADIUS, float(size.min()))
        inner = size - radius
        steps = [np.linspace(-s, s, max(int(np.ceil(s / radius)), 1) + 1) for s in inner]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[np.any(np.abs(grid) >= inner - 1e-9, axis=1)]
        parts += _points(model, geom, grid, radius)
    return parts


def filled(model: mujoco.MjModel, body: int) -> list[Part]:
    """A few spheres within a body's shapes: at the ends of the round ones, in a row through boxes.

    Raises:
        InputError: As in :func:`covered`.
    """
    parts = []
    for part in _round(model, body):
        ends = [part.start] if np.array_equal(part.start, part.end) else [part.start, part.end]
        parts += [Part(body, end, end, part.radius) for end in ends]
    for geom in _boxes(model, body):
        size = model.geom_size[geom]
        radius = float(size.min())
        steps = [np.linspace(radius - s, s - radius, round(s / radius)) for s in size]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        parts += _points(model, geom, grid, radius)
    return parts


def solids(
    parts: list[Part], frame_of: dict[int, int], groups: list[list[int]], names: tuple[str, ...]
) -> Solids:
    """Parts as arrays.

    Args:
        parts: On bodies of the robot.
        frame_of: The frame of each body.
        groups: Parts that share constraints.
        names: Of the groups.
    """
    return Solids(
        frame=np.array([frame_of[part.body] for part in parts]),
        start=np.array([part.start for part in parts], np.float32),
        end=np.array([part.end for part in parts], np.float32),
        radius=np.array([part.radius for part in parts], np.float32),
        groups=padded(groups),
        names=names,
    )


def cells(points: list[Part]) -> list[list[int]]:
    """Points of one body in groups of nearby ones, the cells of a grid.

    Were the members of a group far apart, the nearest one could change to one that a turn of the
    body sweeps towards the object unchecked.
    """
    at = np.array([point.start for point in points])
    extent = np.ptp(at, axis=0)
    parts = np.maximum(np.ceil(extent / _CELL), 1).astype(int)
    share = (at - at.min(axis=0)) / np.where(extent > 0, extent, 1.0)
    cell = np.minimum((parts * share).astype(int), parts - 1)
    index = np.ravel_multi_index(tuple(cell.T), tuple(parts))
    return [np.flatnonzero(index == k).tolist() for k in np.unique(index)]


def padded(groups: list[list]) -> np.ndarray:
    """Groups of different lengths as an array, filled up with their first members."""
    longest = max(len(g) for g in groups)
    return np.array([[*g, *([g[0]] * (longest - len(g)))] for g in groups])


def may_touch(model: mujoco.MjModel) -> Bool[np.ndarray, "bodies bodies"]:
    """Which pairs of bodies the model checks against each other."""
    free = ~np.eye(model.nbody, dtype=bool)
    children = np.arange(1, model.nbody)
    excluded = [(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature]
    for a, b in [*zip(children, model.body_parentid[1:], strict=True), *excluded]:
        free[a, b] = free[b, a] = False
    return free


def _touching(model: mujoco.MjModel, body: int) -> list[int]:
    """Shapes of a body that can touch something."""
    first = int(model.body_geomadr[body])
    geoms = range(first, first + int(model.body_geomnum[body]))
    return [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]


def _boxes(model: mujoco.MjModel, body: int) -> list[int]:
    box = mujoco.mjtGeom.mjGEOM_BOX
    return [g for g in _touching(model, body) if model.geom_type[g] == box]


def _round(model: mujoco.MjModel, body: int) -> list[Part]:
    """A body's shapes but for boxes; a cylinder by the capsule that encloses it."""
    found = []
    for geom in _touching(model, body):
        kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            continue
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            half, radius = 0.0, size[0]
        elif kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            half, radius = size[1], size[0]
        else:
            name = model.geom(geom).name
            raise InputError("robot", f"geom {name} of another type", "capsules, spheres, boxes")
        along = half * _matrix(model.geom_quat[geom])[:, 2]
        at = model.geom_pos[geom]
        found.append(Part(body, at - along, at + along, float(radius)))
    return found


def _points(
    model: mujoco.MjModel, geom: int, centres: Float[np.ndarray, "n 3"], radius: float
) -> list[Part]:
    """Spheres at places in a shape's frame."""
    body = int(model.geom_bodyid[geom])
    placed = model.geom_pos[geom] + centres @ _matrix(model.geom_quat[geom]).T
    return [Part(body, p, p, radius) for p in placed]


def _matrix(quat: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)
