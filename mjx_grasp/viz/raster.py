"""Pictures of meshes without any graphics library: what each pixel of a camera sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Orthographic:
    """A camera without perspective. Pixels: x to the right, y down, centres at k + 0.5."""

    axes: Float[np.ndarray, "3 3"]
    """Rows: right, up and towards the viewer, unit, in the mesh's frame."""
    centre: Float[np.ndarray, " 3"]
    """What is seen in the middle of the picture [m]."""
    pixels_per_metre: float
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Pixel coordinates x and y of points, and their height towards the viewer [m]."""
        right, up, near = np.moveaxis((points - self.centre) @ self.axes.T, -1, 0)
        x = 0.5 * self.width + self.pixels_per_metre * right
        y = 0.5 * self.height - self.pixels_per_metre * up
        return np.stack([x, y, near], axis=-1)


class Fragments(NamedTuple):
    """What each pixel sees.

    Attributes:
        face: ``[h, w]`` index of the face, -1 where there is none.
        weights: ``[h, w, 3]`` barycentric weights of the face's corners, 0 where there is none.
        near: ``[h, w]`` height towards the viewer [m], minus infinity where there is none.
    """

    face: Int[np.ndarray, "h w"]
    weights: Float[np.ndarray, "h w 3"]
    near: Float[np.ndarray, "h w"]


def look_from(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Axes (right, up, towards the viewer) of a camera that looks at the origin, z up.

    Args:
        azimuth: Of the viewer about z, from +x [rad].
        elevation: Of the viewer above the xy plane, short of straight down [rad].
    """
    near = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(near, right), near])


def fitted(
    points: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
    margin: float = 0.06,
) -> Orthographic:
    """The camera of these axes whose picture the points fill, but for a margin (a share)."""
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    extent = np.maximum(high - low, 1e-9)
    scale = (1.0 - 2.0 * margin) * min(width / extent[0], height / extent[1])
    return Orthographic(axes, axes.T @ (0.5 * (low + high)), float(scale), width, height)


def rasterise(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: Orthographic
) -> Fragments:
    """The nearest face in each pixel, by a ray through its centre; both sides are seen."""
    # Warp takes half a second to import.
    from mjx_grasp.geometry.bvh import MeshTrees

    corners = camera.project(np.asarray(vertices, np.float64))
    # In the camera's frame, from below: the farthest face on a ray is the nearest to the viewer.
    bottom = corners[:, 2].min() - 1.0 / camera.pixels_per_metre
    points = np.column_stack([corners[:, :2] / camera.pixels_per_metre, corners[:, 2] - bottom])
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    origins = np.column_stack([pixels / camera.pixels_per_metre, np.zeros(len(pixels))])
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), origins.shape)
    trees = MeshTrees([points.astype(np.float32)], [np.asarray(faces)])
    rays = jnp.zeros(len(pixels), jnp.int32), jnp.asarray(origins, jnp.float32), jnp.asarray(up)
    face = np.asarray(trees.farthest_faces(*rays), np.int64)
    a, b, c = (corners[faces[face, k]] for k in range(3))
    share = np.stack([_twice(b, c, pixels), _twice(c, a, pixels), _twice(a, b, pixels)], axis=1)
    seen = face >= 0
    weights = share / np.where(seen, share.sum(axis=1), 1.0)[:, None] * seen[:, None]
    height = np.stack([a[:, 2], b[:, 2], c[:, 2]], axis=1)
    near = np.where(seen, (weights * height).sum(axis=1), -np.inf)
    shape = (camera.height, camera.width)
    return Fragments(face.reshape(shape), weights.reshape(*shape, 3), near.reshape(shape))


def _twice(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Twice the signed areas of triangles in the picture."""
    return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])
