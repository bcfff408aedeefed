"""What is asked of a triangle mesh everywhere: normals, areas, centre and principal axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.vectors import unit

# Twice a triangle's area over its longest squared side, below which it has no normal.
_NO_AREA = 1e-9
# Length of a sum of normals over the sum of their lengths, below which it is rounding.
_NO_DIRECTION = 1e-9
# Second moments closer than this, relative to the largest, are equal: they single out no axis.
_EQUAL_MOMENTS = 1e-6


class SurfaceNormals(NamedTuple):
    """Normals of a mesh.

    Attributes:
        faces: ``[f, 3]`` outward unit normals, zero for a face without area.
        areas: ``[f]`` in [m²].
        vertices: ``[v, 3]`` area-weighted unit normals (method §1), zero where no face gives one.
    """

    faces: np.ndarray
    areas: np.ndarray
    vertices: np.ndarray


class Triangles(NamedTuple):
    """Faces of a mesh as contiguous rows of x, y and z, in double precision: each ``[3, f]``.

    Attributes:
        a, b, c: Corners in [m].
        cross: ``(b − a) × (c − a)`` in [m²]: outward, as long as twice the area.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    cross: np.ndarray


class PrincipalFrame(NamedTuple):
    """How the mass of a mesh of uniform density is spread."""

    centre: Float[np.ndarray, " 3"]
    """centre of mass, mesh frame [m]"""
    axes: Float[np.ndarray, "3 3"]
    """unit principal axes as rows, the longest extent (least inertia) first; of equal extents the
    axis nearest to x, then y, then z first"""


def triangles_of(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Triangles:
    """The faces of a mesh, with what their normals and the mesh's mass both hang on."""
    a, b, c = corner_rows(np.asarray(vertices, np.float64), faces)
    return Triangles(a, b, c, cross_rows(b - a, c - a))


def surface_normals(
    triangles: Triangles, faces: Int[np.ndarray, "f 3"], vertices: int
) -> SurfaceNormals:
    """Normals and areas of a mesh, in double precision on the host.

    Not on the device: scattered sums there depend on the order of its threads, and the same mesh
    shall give the same bits. A face without area has no normal and takes no part.

    Args:
        triangles: The faces.
        faces: Their indices of vertices.
        vertices: How many vertices there are.
    """
    a, b, c, cross = triangles
    edge1, edge2 = b - a, c - a
    twice = np.sqrt(dot_rows(cross, cross))
    longest = np.maximum(dot_rows(edge1, edge1), dot_rows(edge2, edge2))
    flat = twice <= _NO_AREA * longest
    cross, twice = np.where(flat, 0.0, cross), np.where(flat, 0.0, twice)
    index = faces.T.ravel()
    # Opposite faces that share a vertex cancel up to rounding: no direction either.
    *weighted, total = (np.bincount(index, np.tile(row, 3), vertices) for row in (*cross, twice))
    length = np.sqrt(dot_rows(weighted, weighted))
    length = np.where(length > _NO_DIRECTION * total, length, np.inf)
    return SurfaceNormals(
        faces=(cross / np.where(flat, np.inf, twice)).T,
        areas=0.5 * twice,
        vertices=(np.stack(weighted) / length).T,
    )


def vertex_areas(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " v"]:
    """The share of the surface that is each vertex's: a third of the faces around it, [m²]."""
    areas = surface_normals(triangles_of(vertices, faces), faces, len(vertices)).areas
    return np.bincount(faces.T.ravel(), np.tile(areas / 3.0, 3), len(vertices))


def bounds(vertices: Float[np.ndarray, "v 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box around vertices, in their unit."""
    # Of columns that are contiguous: NumPy reduces them many times faster.
    rows = np.ascontiguousarray(vertices.T)
    return rows.min(axis=1), rows.max(axis=1)


def corner_rows(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Positions ``[3, f]`` of the three corners of every face: contiguous rows of x, y and z."""
    rows = np.ascontiguousarray(vertices.T)
    # They are indices of vertices: to have that checked again takes four times as long.
    return tuple(np.take(rows, faces[:, k], axis=1, mode="clip") for k in range(3))


def dot_rows(
    a: Sequence[np.ndarray] | np.ndarray, b: Sequence[np.ndarray] | np.ndarray
) -> np.ndarray:
    """Inner products of vectors given as rows of x, y and z."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors given as rows; several times faster than ``np.cross``."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def interpolate_normals(
    normals: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    face: Int[Array, "*batch"],
    barycentric: Float[Array, "*batch 3"],
) -> Float[Array, "*batch 3"]:
    """Unit normals at surface points: barycentric interpolation of vertex normals (method §1).

    Args:
        normals: Unit vertex normals.
        faces: Vertex indices of the faces.
        face: Which face each point lies on.
        barycentric: Its weights of the face's three vertices.
    """
    corners = normals[faces[face]] * barycentric[..., None]
    return unit(corners[..., 0, :] + corners[..., 1, :] + corners[..., 2, :])


def is_closed(
    faces: Int[np.ndarray, "f 3"], vertices: Float[np.ndarray, "v 3"] | None = None
) -> bool:
    """Whether every edge is run along by as many faces in one direction as in the other.

    Then the surface has no boundary: it winds around every point a whole number of times, and this
    number changes only across it.

    Args:
        faces: Indices of vertices.
        vertices: Those at the same place count as one; without them every index is its own place.
    """
    if vertices is not None:
        _, place = np.unique(vertices, axis=0, return_inverse=True)
        faces = place.reshape(-1)[faces]
    count = int(faces.max(initial=0)) + 1
    tail = faces.T.ravel().astype(np.int32 if count**2 < 2**31 else np.int64)
    head = np.roll(tail, -len(faces))
    return np.array_equal(np.sort(tail * count + head), np.sort(head * count + tail))


def principal_frame(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> PrincipalFrame:
    """Centre of mass and principal axes at uniform density (method §1, 2 and S_COM).

    A closed mesh is integrated over its volume (signed tetrahedra), an open one, or one without
    volume, over its surface.
    """
    vertices = np.asarray(vertices, np.float64)
    low, high = bounds(vertices)
    origin = 0.5 * (low + high)
    found = principal_frame_of(
        triangles_of(vertices - origin, faces), faces, np.linalg.norm(high - low)
    )
    return found._replace(centre=found.centre + origin)


def principal_frame_of(
    triangles: Triangles, faces: Int[np.ndarray, "f 3"], diagonal: float | np.floating
) -> PrincipalFrame:
    """:func:`principal_frame` of a mesh around the middle of its box, whose diagonal is in [m]."""
    a, b, c, cross = triangles
    volumes = dot_rows(a, cross) / 6.0
    closed = volumes.sum() > 1e-9 * diagonal**3 and is_closed(faces)
    # ∫x dm and ∫xxᵀ dm of a simplex with the corners v: m/(k)·Σv and m/(k(k+1))·(Σvvᵀ + ssᵀ), with
    # k corners; a tetrahedron's fourth corner is the origin.
    mass, k = (volumes, 4) if closed else (0.5 * np.sqrt(dot_rows(cross, cross)), 3)
    total = mass.sum()
    if not total > 0:
        return PrincipalFrame(np.zeros(3), np.eye(3))
    sums = a + b + c
    centre = sums @ mass / (k * total)
    points = np.concatenate([a, b, c, sums], axis=1)
    second = (np.tile(mass, 4) * points) @ points.T / (k * (k + 1) * total)
    moments, vectors = np.linalg.eigh(second - np.outer(centre, centre))
    axes = _settled(vectors.T[::-1], moments[::-1])
    return PrincipalFrame(centre, axes)


def _settled(axes: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Of axes with equal moments, which rounding would choose, those nearest to x, y, z instead."""
    settled = np.empty((3, 3))
    start = 0
    while start < 3:
        stop = start + 1
        while stop < 3 and moments[stop - 1] - moments[stop] <= _EQUAL_MOMENTS * moments[0]:
            stop += 1
        if stop == start + 1:
            settled[start] = axes[start]
        else:
            space = axes[start:stop].T @ axes[start:stop]
            for row in range(start, stop):
                lengths = np.sqrt(np.maximum(np.diagonal(space), 0.0))
                # Of equally near coordinate axes the first.
                nearest = np.argmax(lengths >= lengths.max() - _EQUAL_MOMENTS)
                settled[row] = space[nearest] / lengths[nearest]
                space = space - np.outer(settled[row], settled[row])
        start = stop
    return settled
