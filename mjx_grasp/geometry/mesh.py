"""What is asked of a triangle mesh everywhere: normals, areas, centre and principal axes."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.vectors import norm, unit


class MassProperties(NamedTuple):
    """Uniform-density properties of a mesh.

    Attributes:
        centre: ``[3]`` centre of mass in [m], mesh frame.
        axes: ``[3, 3]`` unit principal axes as rows, the longest extent (least inertia) first.
        closed: Whether the mesh bounds a volume; of an open one the surface is taken.
    """

    centre: np.ndarray
    axes: np.ndarray
    closed: bool


def face_normals_and_areas(
    triangles: Float[Array, "f 3 3"],
) -> tuple[Float[Array, "f 3"], Float[Array, " f"]]:
    """Outward unit normals (zero for a degenerate face) and areas in [m²] of triangles."""
    cross = jnp.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return unit(cross), 0.5 * norm(cross)


def vertex_normals(
    face_normals: Float[Array, "f 3"],
    face_areas: Float[Array, " f"],
    faces: Int[Array, "f 3"],
    vertex_count: int,
) -> Float[Array, "v 3"]:
    """Area-weighted unit vertex normals (method §1); zero where no face gives a direction."""
    weighted = jnp.repeat(face_normals * face_areas[:, None], 3, axis=0)
    return unit(jnp.zeros((vertex_count, 3), weighted.dtype).at[faces.reshape(-1)].add(weighted))


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


def is_closed(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether every edge is shared by as many faces in one direction as in the other."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return np.array_equal(forward, backward)


def mass_properties(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> MassProperties:
    """Centre of mass and principal axes at uniform density (method §1, 2 and S_COM).

    A closed mesh is integrated over its volume (signed tetrahedra), an open one, or one without
    volume, over its surface.
    """
    vertices = np.asarray(vertices, np.float64)
    origin = vertices.mean(axis=0)
    corners = vertices[faces] - origin
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    cross = np.cross(b - a, c - a)
    areas = 0.5 * np.linalg.norm(cross, axis=1)
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6.0
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    closed = is_closed(faces) and volumes.sum() > 1e-9 * diagonal**3
    # ∫x dm and ∫xxᵀ dm of a simplex with the corners v: m/(k)·Σv and m/(k(k+1))·(Σvvᵀ + ssᵀ), with
    # k corners; a tetrahedron's fourth corner is the origin.
    mass, k = (volumes, 4) if closed else (areas, 3)
    total = mass.sum()
    if not total > 0:
        return MassProperties(origin, np.eye(3), closed)
    sums = corners.sum(axis=1)
    centre = (mass[:, None] * sums).sum(axis=0) / (k * total)
    second = np.einsum("f,fki,fkj->ij", mass, corners, corners)
    second = (second + np.einsum("f,fi,fj->ij", mass, sums, sums)) / (k * (k + 1) * total)
    _, vectors = np.linalg.eigh(second - np.outer(centre, centre))
    return MassProperties(centre + origin, np.ascontiguousarray(vectors.T[::-1]), closed)
