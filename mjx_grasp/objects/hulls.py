"""Convex hulls with a bounded number of vertices that keep their corners."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError


def reduced_hull(
    points: Float[np.ndarray, "n 3"], max_vertices: int = 64
) -> Float[np.ndarray, "m 3"]:
    """The points, at most ``max_vertices`` of them, whose hull loses the least of the full hull.

    Starts from the extreme points along the principal axes and adds, one at a time, the point that
    is farthest outside the hull so far: corners are farthest outside and therefore stay, where
    merging or clustering vertices would cut them.

    Raises:
        ValueError: The points lie in a plane.
    """
    try:
        hull_points = points[ConvexHull(points).vertices]
    except QhullError as error:
        raise ValueError("the points span no volume") from error
    if len(hull_points) <= max_vertices:
        return hull_points
    chosen = _seed(hull_points)
    while len(chosen) < max_vertices:
        faces = ConvexHull(hull_points[chosen]).equations
        outside = (hull_points @ faces[:, :3].T + faces[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        farthest = int(np.argmax(outside))
        if outside[farthest] <= 1e-9:
            break
        chosen.append(farthest)
    return hull_points[np.sort(chosen)]


def hull_mesh(vertices: Float[np.ndarray, "n 3"]) -> trimesh.Trimesh:
    """The convex hull of the vertices as a closed mesh, wound outwards."""
    hull = ConvexHull(vertices)
    faces = hull.simplices.copy()
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = (normal * hull.equations[:, :3]).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(vertices[used], faces.reshape(-1, 3), process=False)


def _seed(points: np.ndarray) -> list[int]:
    """Indices of extreme points that span a volume."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    along = points @ axes.T
    chosen = sorted(set(along.argmax(axis=0).tolist()) | set(along.argmin(axis=0).tolist()))
    spread = points[chosen] - points[chosen[0]]
    while np.linalg.matrix_rank(spread, tol=1e-6 * np.abs(along).max()) < 3:
        # The extremes lie in a plane: add the point farthest from that plane (or line).
        basis = np.linalg.svd(spread)[2]
        rank = np.linalg.matrix_rank(spread, tol=1e-6 * np.abs(along).max())
        rest = (points - points[chosen[0]]) @ basis[rank:].T
        chosen = sorted({*chosen, int(np.argmax((rest**2).sum(axis=1)))})
        spread = points[chosen] - points[chosen[0]]
    return chosen
