"""How far the hand is from object and table, smoothly enough for the IK to move away.

The hand is its set of spheres, the object a grid of signed distances to its convex pieces. This
guides the solver; whether a state is free of collisions is MuJoCo's to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float
from scipy.spatial import ConvexHull

if TYPE_CHECKING:
    from mjx_grasp.objects.model import Piece

_RESOLUTION = 40
# The grid reaches this far beyond the object; farther away nothing pushes.
_BORDER = 0.04


class DistanceGrid(NamedTuple):
    """Signed distances to an object on a regular grid in its frame; negative inside.

    Attributes:
        values: ``[n, n, n]`` in [m].
        origin: ``[3]`` the first grid point, [m].
        spacing: ``[3]`` between grid points, [m].
    """

    values: Float[np.ndarray, "n n n"]
    origin: Float[np.ndarray, " 3"]
    spacing: Float[np.ndarray, " 3"]


def distance_grid(pieces: Sequence[Piece]) -> DistanceGrid:
    """Signed distances to the union of an object's convex pieces.

    A hull's distance is that to its farthest face plane: exact inside and before a face, less
    than the true one beyond edges.

    Args:
        pieces: Spheres and hulls, in the object frame.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in pieces:
        if piece.kind == "sphere":
            points = np.asarray(piece.pos) + piece.radius * np.array([[-1.0] * 3, [1.0] * 3])
        else:
            points = np.asarray(piece.vertices)
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    low, high = low - _BORDER, high + _BORDER
    steps = [np.linspace(a, b, _RESOLUTION) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.full(len(grid), np.inf)
    for piece in pieces:
        if piece.kind == "sphere":
            distance = np.linalg.norm(grid - np.asarray(piece.pos), axis=1) - piece.radius
        else:
            planes = np.unique(ConvexHull(piece.vertices).equations.round(9), axis=0)
            distance = (grid @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        values = np.minimum(values, distance)
    shape = (_RESOLUTION,) * 3
    spacing = (high - low) / (_RESOLUTION - 1)
    arrays = (values.reshape(shape), low, spacing)
    return DistanceGrid(*(np.asarray(array, np.float32) for array in arrays))


def distance_and_gradient(
    grid: DistanceGrid, points: Float[Array, "s 3"]
) -> tuple[Float[Array, " s"], Float[Array, "s 3"]]:
    """Signed distance in [m] and its gradient at points of the object frame (trilinear)."""

    def distance(point):
        place = (point - grid.origin) / grid.spacing
        return map_coordinates(grid.values, list(place), order=1, mode="nearest")

    return jax.vmap(jax.value_and_grad(distance))(points)


def outside_clearance(
    grid: DistanceGrid,
    points: Float[Array, "s 3"],
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
) -> tuple[Float[Array, " s"], Float[Array, "s 3"]]:
    """Distance in [m] of world points to the nearer of object and table, and the way off it.

    Args:
        grid: The object.
        points: Points in world, [m].
        p_wo: Object origin in world, [m].
        R_wo: Object rotation.
    """
    distance, slope = distance_and_gradient(grid, (points - p_wo) @ R_wo)
    height = points[:, 2]
    up = jnp.asarray([0.0, 0.0, 1.0], points.dtype)
    away = jnp.where((height < distance)[:, None], up, slope @ R_wo.T)
    return jnp.minimum(distance, height), away
