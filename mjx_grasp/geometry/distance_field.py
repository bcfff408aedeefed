"""A signed-distance grid of a mesh, built once per object, from exact point–triangle distances.

Distances come from the faces whose samples are nearest, the sign from the generalised winding
number, which needs no watertight surface and takes overlapping parts for their union. Only points
near the surface are asked for their sign: it cannot change anywhere else.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.closest import closest_on_triangle
from mjx_grasp.geometry.signed_distance import DistanceField
from mjx_grasp.geometry.vectors import dot, norm

# Faces are sampled this densely relative to the grid, so that the nearest face is among the
# nearest few samples'.
_SAMPLE_STEP = 0.5
_NEIGHBOURS = 12
_TILE = 200_000
_WINDING_TILE = 4_096


def distance_field(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    spacing: float = 0.002,
    border: float = 0.03,
) -> DistanceField:
    """Samples the signed distance to a mesh on a regular grid around it.

    Args:
        vertices: In the object frame, [m].
        faces: Indices, wound so that normals point outwards.
        spacing: Between grid points, [m].
        border: How far the grid reaches beyond the mesh, [m].

    Raises:
        InputError: No faces, or lengths that make no grid.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if len(faces) == 0:
        raise InputError("faces", "none", "at least one")
    if not 0 < spacing < np.ptp(vertices, axis=0).max() or border < spacing:
        raise InputError("spacing, border", (spacing, border), "0 < spacing <= border, in m")
    low = vertices.min(axis=0) - border
    counts = np.ceil((vertices.max(axis=0) + border - low) / spacing).astype(int) + 1
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    triangles = vertices[faces]
    distance = _unsigned(grid, triangles, _SAMPLE_STEP * spacing * 2)
    inside = _inside(grid, distance, triangles, tuple(counts), spacing)
    values = np.where(inside, -distance, distance).reshape(tuple(counts))
    f32 = jnp.float32
    return DistanceField(jnp.asarray(values, f32), jnp.asarray(low, f32), f32(spacing))


def _samples(triangles: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Points that cover every face at most a step apart, and the face of each."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1)
    divisions = np.maximum(np.ceil(edges / step).astype(int), 1)
    points, owner = [], []
    for n in np.unique(divisions):
        at = np.flatnonzero(divisions == n)
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=-1) / n
        points.append(np.einsum("sk,fkd->fsd", weights, triangles[at]).reshape(-1, 3))
        owner.append(np.repeat(at, len(weights)))
    return np.concatenate(points), np.concatenate(owner)


def _unsigned(grid: np.ndarray, triangles: np.ndarray, step: float) -> np.ndarray:
    points, owner = _samples(triangles, step)
    tree = cKDTree(points)
    distance = np.empty(len(grid))
    for first in range(0, len(grid), _TILE):
        part = grid[first : first + _TILE]
        near, index = tree.query(part, k=min(_NEIGHBOURS, len(points)), workers=-1)
        near, index = near.reshape(len(part), -1), index.reshape(len(part), -1)
        best = near[:, 0].copy()
        # Far away the samples are as good as the faces.
        close = np.flatnonzero(best < 20 * step)
        if len(close):
            candidates = triangles[owner[index[close]]]
            query = np.repeat(part[close, None], candidates.shape[1], axis=1)
            exact = _to_triangles(query, candidates)
            best[close] = np.minimum(best[close], exact.min(axis=1))
        distance[first : first + _TILE] = best
    return distance


def _to_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    nearest, _ = closest_on_triangle(
        jnp.asarray(points, jnp.float32), jnp.asarray(triangles, jnp.float32)
    )
    return np.linalg.norm(points - np.asarray(nearest, np.float64), axis=-1)


def winding_number(
    points: Float[np.ndarray, "n 3"], triangles: Float[np.ndarray, "f 3 3"]
) -> Float[np.ndarray, " n"]:
    """How often a surface winds around points: about 1 inside, 0 outside, between near a gap.

    The sum of the signed solid angles of all faces over 4π (Van Oosterom and Strackee 1983).
    """
    points = np.asarray(points, np.float32)
    # Filled up to a multiple of the tile, for few compilations.
    filled = np.concatenate([points, np.zeros((-len(points) % _WINDING_TILE, 3), np.float32)])
    total = [
        np.asarray(_solid_angles(part, np.asarray(triangles, np.float32)))
        for part in np.split(filled, max(len(filled) // _WINDING_TILE, 1))
    ]
    return np.concatenate(total)[: len(points)] / (2 * np.pi)


@jax.jit
def _solid_angles(points, triangles):
    """Half the sum of the faces' solid angles, seen from each point."""

    def around(point):
        a, b, c = (triangles[:, k] - point for k in range(3))
        la, lb, lc = norm(a), norm(b), norm(c)
        volume = dot(a, jnp.cross(b, c))
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        return jnp.sum(jnp.arctan2(volume, below))

    return jax.lax.map(around, points, batch_size=64)


def _inside(
    grid: np.ndarray,
    distance: np.ndarray,
    triangles: np.ndarray,
    shape: tuple[int, ...],
    spacing: float,
) -> Bool[np.ndarray, " n"]:
    """Which points are inside: regions without surface have one sign, the others are asked each."""
    # Between neighbours that are both farther than half their distance there is no surface.
    free = (distance > 0.51 * spacing).reshape(shape)
    labels, count = ndimage.label(free)
    flat = labels.reshape(-1)
    # One question for each region, at its deepest point.
    order = np.argsort(-distance, kind="stable")
    first = np.full(count + 1, -1)
    seen, where = np.unique(flat[order], return_index=True)
    first[seen] = order[where]
    asked = first[1:]
    sign = np.zeros(count + 1, bool)
    if count:
        sign[1:] = winding_number(grid[asked], triangles) > 0.5
    inside = sign[flat]
    near = np.flatnonzero(flat == 0)
    inside[near] = winding_number(grid[near], triangles) > 0.5
    return inside
