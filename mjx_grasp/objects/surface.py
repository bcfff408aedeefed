"""Closest points, inside tests and samples of triangle meshes in NumPy, for offline geometry."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

_CANDIDATES = 24  # small triangles examined per point; their centroids are the nearest ones
_BLOCK = 4_000_000  # point-triangle pairs held in memory at once
_RAYS = 64  # points whose rays are followed at once
_RAY = (
    0.2718281,
    0.1414213,
)  # x and y of their direction, z is 1: in no plane that a mesh is likely to have


def closest_on_triangles(
    points: Float[np.ndarray, "*batch 3"], triangles: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """The point of each triangle that is closest to its point (m, any frame).

    The regions of Ericson, Real-Time Collision Detection, 5.1.5: the closest point lies inside the
    triangle if its projection does, else on the nearest of the three edges.
    """
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    squared = np.maximum((normal**2).sum(-1), 1e-300)
    offset = ((points - a) * normal).sum(-1) / squared
    best = points - offset[..., None] * normal
    inside = np.ones(best.shape[:-1], bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, best - start) * normal).sum(-1) >= 0
    distance = np.where(inside, ((best - points) ** 2).sum(-1), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        length = np.maximum((edge**2).sum(-1), 1e-300)
        t = np.clip(((points - start) * edge).sum(-1) / length, 0.0, 1.0)
        candidate = start + t[..., None] * edge
        d = ((candidate - points) ** 2).sum(-1)
        nearer = d < distance
        best = np.where(nearer[..., None], candidate, best)
        distance = np.where(nearer, d, distance)
    return best


def distance_to_surface(
    mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Unsigned distance (m) from each point to the mesh's surface.

    Long triangles are first divided to edges of 3 % of the mesh's diagonal, so that the nearest
    centroids belong to the triangles that can be nearest.
    """
    limit = 0.03 * float(np.linalg.norm(mesh.extents))
    vertices, faces = trimesh.remesh.subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=limit, max_iter=24
    )
    triangles = np.asarray(vertices)[np.asarray(faces)]
    tree = cKDTree(triangles.mean(axis=1))
    k = min(_CANDIDATES, len(triangles))
    _, index = tree.query(points, k=k)
    index = np.asarray(index).reshape(len(points), k)
    distance = np.empty(len(points))
    step = max(1, _BLOCK // (8 * k))
    for i in range(0, len(points), step):
        block = points[i : i + step, None, :]
        near = closest_on_triangles(np.repeat(block, k, axis=1), triangles[index[i : i + step]])
        distance[i : i + step] = np.sqrt(((near - block) ** 2).sum(-1).min(axis=1))
    return distance


def inside(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether each point is inside the closed mesh: its winding number is above 0.

    The winding number is what a ray from the point leaves the surface more often than it enters it.
    Overlapping closed components count as their union. On the surface the answer may be either.
    """
    # Sheared so that the ray runs along z, and sorted so that a block of points meets few faces.
    shear = np.eye(3)
    shear[2, :2] -= _RAY
    triangles, points = np.asarray(mesh.triangles) @ shear, points @ shear
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    order = np.argsort(points[:, 0])
    winding = np.zeros(len(points))
    for i in range(0, len(points), _RAYS):
        rows = order[i : i + _RAYS]
        start = points[rows, None]
        near = np.flatnonzero((low[:, 0] <= start[-1, 0, 0]) & (high[:, 0] >= start[0, 0, 0]))
        met = (low[near, :2] <= start[..., :2]).all(axis=-1) & (high[near] >= start).all(axis=-1)
        ray, face = np.nonzero(met)
        ends = triangles[near[face]] - start[ray]
        # Of each corner twice the area between the ray's foot and the other two, seen along it.
        x, y, z = np.moveaxis(ends, -1, 0)
        area = np.roll(x, -1, 1) * np.roll(y, -2, 1) - np.roll(x, -2, 1) * np.roll(y, -1, 1)
        side = np.sign(area.sum(axis=1))
        hit = (np.sign(area) == side[:, None]).all(axis=1) & (side * (area * z).sum(axis=1) > 0)
        winding[rows] = np.bincount(ray[hit], side[hit], len(rows))
    return winding > 0.5


def outside_distance(
    mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """How far outside the closed mesh each point lies (m); 0 for points inside it."""
    return np.where(inside(mesh, points), 0.0, distance_to_surface(mesh, points))


def sample_surface(
    triangles: Float[np.ndarray, "f 3 3"], count: int, seed: int
) -> tuple[Float[np.ndarray, "count 3"], Int[np.ndarray, " count"]]:
    """Points spread evenly by area, and the triangle that each came from; repeatable by seed."""
    rng = np.random.default_rng(seed)
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
    cumulative = np.cumsum(area)
    # Stratified along the cumulative area: less spread in the percentiles than independent draws.
    level = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, level), len(triangles) - 1)
    u, v = rng.random((2, count))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    points = triangles[face, 0] + u[:, None] * edges[face, 0] + v[:, None] * edges[face, 1]
    return points, face
