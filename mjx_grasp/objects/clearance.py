"""Distances to an object as collisions know it, on a grid: what a hand keeps away from."""

from __future__ import annotations

import numpy as np

from mjx_grasp.geometry.distance_field import distance_cube
from mjx_grasp.geometry.signed_distance import DistanceField
from mjx_grasp.objects.model import ObjectModel


def collision_field(obj: ObjectModel, points: int = 64) -> DistanceField:
    """Signed distances to the pieces that collisions are checked with, object frame.

    All objects have grids of one size, so that one compiled program serves them all.

    Args:
        obj: The object.
        points: Along each edge of the grid.
    """
    surfaces = [piece.surface() for piece in obj.pieces]
    before = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    vertices = np.concatenate([s.vertices for s in surfaces])
    faces = np.concatenate([s.faces + n for s, n in zip(surfaces, before, strict=True)])
    return distance_cube(vertices, faces, points)
