"""Generators of closed, outward-wound, evenly triangulated shapes: skins over rings, and boxes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

_OUTLINE = 256  # points of a section's outline before it is divided evenly
_FEWEST = 6  # points of the smallest ring


def lathe(profile: Float[np.ndarray, "n 2"], edge: float) -> trimesh.Trimesh:
    """The solid of revolution about z of a profile.

    Args:
        profile: Rows (radius, z) in m, from the axis at the bottom outwards and up, and back to
            the axis; a vessel's profile goes up outside and down inside. Ends off the axis are
            closed by flat discs.
        edge: Length of the triangles' edges, m.
    """
    radius, z = np.asarray(profile, dtype=np.float64).T
    return loft(np.stack([z, radius, radius], axis=1), edge)


def loft(
    rows: Float[np.ndarray, "n k"], edge: float, exponent: float = 2.0, lean: float = 0.0
) -> trimesh.Trimesh:
    """The solid between horizontal sections, superellipses |x/a|^p + |y/b|^p = 1 with centre on z.

    Args:
        rows: (z, a, b) in m, or (z, a, b, p) where the exponent changes, in the order of ``lathe``.
        edge: Length of the triangles' edges, m.
        exponent: p where the rows do not give it: 2 an ellipse, 4 a box with round edges.
        lean: Displacement of the sections along x per height, for a body that leans.
    """
    rows = np.asarray(rows, dtype=np.float64)
    if rows.shape[1] == 3:
        rows = np.column_stack([rows, np.full(len(rows), exponent)])
    z, a, b, p = _divided(rows, edge, measured=3).T
    centres = np.stack([lean * z, np.zeros_like(z), z], axis=1)
    x_axis, y_axis = np.tile([1.0, 0.0, 0.0], (len(z), 1)), np.tile([0.0, 1.0, 0.0], (len(z), 1))
    return _tube(centres, x_axis, y_axis, a, b, p, edge)


def swept(
    path: Float[np.ndarray, "n 3"],
    half_across: float | Float[np.ndarray, " n"],
    half_up: float | Float[np.ndarray, " n"],
    edge: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    exponent: float = 2.0,
) -> trimesh.Trimesh:
    """The solid that a superellipse sweeps along a path, closed by flat ends.

    Args:
        path: Points of the centre line, m; neighbours differ.
        half_across: Half the section's size (m) at right angles to the path and to ``up``.
        half_up: Half its size (m) along ``up``; one number, or one per point of the path.
        edge: Length of the triangles' edges, m.
        up: The plane curve's normal, or any direction never along the path.
        exponent: Of the superellipse.
    """
    path = np.asarray(path, dtype=np.float64)
    across = np.broadcast_to(np.asarray(half_across, dtype=np.float64), len(path))
    upward = np.broadcast_to(np.asarray(half_up, dtype=np.float64), len(path))
    rows = _divided(np.column_stack([path, across, upward]), edge, measured=5)
    tangent = _unit(np.gradient(rows[:, :3], axis=0))
    first = _unit(np.cross(tangent, up))
    second = np.cross(tangent, first)
    power = np.full(len(rows), exponent)
    return _tube(rows[:, :3], first, second, rows[:, 3], rows[:, 4], power, edge)


def capsule(
    start: Sequence[float], end: Sequence[float], radius: float, edge: float
) -> trimesh.Trimesh:
    """A cylinder with round ends; ``start`` and ``end`` are the centres of the ends, m."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    direction = _unit(b - a)
    angle = np.linspace(0.0, np.pi / 2, 6)[:-1]
    reach, thick = radius * np.cos(angle), radius * np.sin(angle)
    path = np.concatenate([a - np.outer(reach, direction), b + np.outer(reach[::-1], direction)])
    around = np.concatenate([thick, thick[::-1]])
    # The first and last ring are points; beside them sits the widest ring of each round end.
    path = np.concatenate([path[:5], [a, b], path[5:]])
    around = np.concatenate([around[:5], [radius, radius], around[5:]])
    up = (0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0)
    return swept(path, around, around, edge, up)


def ellipsoid(half: Sequence[float], subdivisions: int = 4) -> trimesh.Trimesh:
    """An ellipsoid about the origin by its semi-axes (m), on an icosphere."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return trimesh.Trimesh(ball.vertices * np.asarray(half), ball.faces, process=False)


def rounded_box(
    extents: Sequence[float], radius: float, edge: float, rounds: int = 2
) -> trimesh.Trimesh:
    """A box about the origin with round edges and corners.

    Args:
        extents: Full sizes, m.
        radius: Of the edges, m; less than half the smallest extent.
        edge: Length of the triangles' edges, m.
        rounds: Cells across an edge's quarter circle, halved on each side of the edge.
    """
    half = np.asarray(extents, dtype=np.float64) / 2.0
    inner = half - radius
    grid = []
    for h, i in zip(half, inner, strict=True):
        flat = np.linspace(-i, i, max(int(np.ceil(2.0 * i / edge)), 1) + 1)
        # Even angles on the sphere rather than even steps on the cube.
        turn = radius * np.tan(np.linspace(0.0, np.pi / 4, rounds + 1)[1:])
        grid.append(np.concatenate([-i - turn[::-1], flat, i + turn]))
        grid[-1][[0, -1]] = -h, h
    vertices, faces = _grid_surface(grid)
    core = np.clip(vertices, -inner, inner)
    away = _unit(vertices - core)
    return trimesh.Trimesh(core + radius * away, faces, process=False)


def smooth(points: Sequence[Sequence[float]], count: int = 24) -> Float[np.ndarray, "count k"]:
    """A cubic spline through the points, at ``count`` even steps of their chord length."""
    nodes = np.asarray(points, dtype=np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    return np.asarray(CubicSpline(along, nodes)(np.linspace(0.0, along[-1], count)))


def arc(
    centre: Sequence[float], radius: float, start: float, end: float, count: int = 5
) -> Float[np.ndarray, "count 2"]:
    """Points of a circle's arc in a profile's plane; angles in degrees from the first axis."""
    angle = np.radians(np.linspace(start, end, count))
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def set_at(
    mesh: trimesh.Trimesh,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    degrees: float = 0.0,
) -> trimesh.Trimesh:
    """The mesh turned about an axis through the origin, then moved to ``at`` (m)."""
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]
    return trimesh.Trimesh(mesh.vertices @ turn.T + np.asarray(at), mesh.faces, process=False)


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """The meshes as closed components of one; where they overlap, they stand for their union."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])[:-1]
    faces = [np.asarray(m.faces) + s for m, s in zip(meshes, start, strict=True)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def _divided(rows: np.ndarray, edge: float, measured: int) -> np.ndarray:
    """Inserts rows so that steps, measured in the first columns, are at most an edge long."""
    pieces = []
    for start, end in itertools.pairwise(rows):
        length = float(np.linalg.norm((end - start)[:measured]))
        # Steps of the rows' own detail stay; only steps above 1.3 edges are divided.
        steps = max(int(np.ceil(length / edge - 0.3)), 1)
        pieces.append(start + (end - start) * np.linspace(0.0, 1.0, steps, endpoint=False)[:, None])
    return np.concatenate([*pieces, rows[-1:]])


def _tube(
    centres: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    power: np.ndarray,
    edge: float,
) -> trimesh.Trimesh:
    """Rings of superellipses about the centres, skinned, with flat ends where they are open."""
    sizes = np.column_stack([a, b])
    for end in (0, -1):
        if sizes[end].max() <= 0.0:
            continue
        steps = max(int(np.ceil(sizes[end].max() / edge - 0.3)), 1)
        shares = np.arange(steps) / steps  # from the middle of the disc outwards
        cap = shares[:, None] * sizes[end]
        repeat = [np.repeat(x[[end]], steps, axis=0) for x in (centres, first, second, power)]
        before, after = (cap, sizes) if end == 0 else (sizes, cap[::-1])
        sizes = np.concatenate([before, after])
        centres, first, second, power = (
            np.concatenate([r, x] if end == 0 else [x, r])
            for r, x in zip(repeat, (centres, first, second, power), strict=True)
        )
    rings = []
    for c, u, v, (x, y), p in zip(centres, first, second, sizes, power, strict=True):
        outline = _outline(x, y, p, edge)
        rings.append(c + outline[:, :1] * u + outline[:, 1:] * v)
    return _skin(rings)


def _outline(a: float, b: float, power: float, edge: float) -> Float[np.ndarray, "n 2"]:
    """Points of a superellipse at even arc lengths, anticlockwise from +x; one if it is a point."""
    if max(a, b) <= 0.0:
        return np.zeros((1, 2))
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE + 1)
    c, s = np.cos(angle), np.sin(angle)
    dense = np.stack(
        [a * np.sign(c) * np.abs(c) ** (2.0 / power), b * np.sign(s) * np.abs(s) ** (2.0 / power)],
        axis=1,
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    # Multiples of four: the points on the axes, and with them the extents, are kept.
    count = max(4 * round(along[-1] / edge / 4), _FEWEST + 2)
    level = np.linspace(0.0, along[-1], count, endpoint=False)
    return np.stack([np.interp(level, along, dense[:, k]) for k in (0, 1)], axis=1)


def _skin(rings: Sequence[Float[np.ndarray, "_ 3"]]) -> trimesh.Trimesh:
    """The closed surface over rings that turn anticlockwise about the direction of their order."""
    start = np.cumsum([0, *(len(ring) for ring in rings)])
    faces: list[tuple[int, int, int]] = []
    for k, (lower, upper) in enumerate(itertools.pairwise(rings)):
        faces += _band(int(start[k]), len(lower), int(start[k + 1]), len(upper))
    return trimesh.Trimesh(np.concatenate(rings), np.array(faces, dtype=np.int64), process=False)


def _band(low: int, n: int, high: int, m: int) -> list[tuple[int, int, int]]:
    """Triangles between two rings, advancing along whichever is behind; a point is a ring of 1."""
    faces = []
    i = j = 0
    while i < n or j < m:
        if j >= m or (i < n and (i + 1) * m <= (j + 1) * n):
            if n > 1:
                faces.append((low + i % n, low + (i + 1) % n, high + j % m))
            i += 1
        else:
            if m > 1:
                faces.append((low + i % n, high + (j + 1) % m, high + j % m))
            j += 1
    return faces


def _grid_surface(
    grid: Sequence[np.ndarray],
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The six faces of a box of grid lines, joined along its edges."""
    shape = [len(g) for g in grid]
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        i, j = np.meshgrid(np.arange(shape[u] - 1), np.arange(shape[v] - 1), indexing="ij")
        for side in (0, shape[axis] - 1):
            corner = []
            for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
                cell = [np.zeros_like(i)] * 3
                cell[axis], cell[u], cell[v] = np.full_like(i, side), i + di, j + dj
                corner.append(np.ravel_multi_index(tuple(cell), tuple(shape)).ravel())
            a, b, c, d = corner if side else corner[::-1]
            faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    used, index = np.unique(np.concatenate(faces), return_inverse=True)
    where = np.unravel_index(used, tuple(shape))
    vertices = np.stack([g[w] for g, w in zip(grid, where, strict=True)], axis=1)
    return vertices, index.reshape(-1, 3)
