"""A small z-buffer rasteriser in NumPy: pictures of meshes without any graphics library."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_PAIRS = 2_000_000  # pixel-triangle pairs held in memory at once


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
    """The nearest face in each pixel, by a z-buffer at pixel centres; both sides are drawn."""
    corners = camera.project(np.asarray(vertices, np.float64))[faces]
    size = np.array([camera.width, camera.height])
    # Pixels whose centres k + 0.5 lie in the triangle's box.
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - 0.5), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) - 0.5) + 1, 0, size).astype(np.int64)
    span = np.maximum(high - low, 0)
    pairs = span[:, 0] * span[:, 1]
    face = np.full(camera.width * camera.height, -1, np.int64)
    weights = np.zeros((len(face), 3))
    near = np.full(len(face), -np.inf)
    total = np.cumsum(pairs)
    start = 0
    while start < len(faces):
        done = total[start - 1] if start else 0
        stop = max(int(np.searchsorted(total, done + _PAIRS, side="right")), start + 1)
        _draw(np.arange(start, stop), corners, low, span, camera.width, face, weights, near)
        start = stop
    shape = (camera.height, camera.width)
    return Fragments(face.reshape(shape), weights.reshape(*shape, 3), near.reshape(shape))


def _draw(
    which: Int[np.ndarray, " d"],
    corners: Float[np.ndarray, "f 3 3"],
    low: Int[np.ndarray, "f 2"],
    span: Int[np.ndarray, "f 2"],
    width: int,
    face: Int[np.ndarray, " pixels"],
    weights: Float[np.ndarray, "pixels 3"],
    near: Float[np.ndarray, " pixels"],
) -> None:
    """Draws some faces into the flat buffers."""
    count = span[which, 0] * span[which, 1]
    index = np.repeat(which, count)
    local = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
    x = low[index, 0] + local % span[index, 0]
    y = low[index, 1] + local // span[index, 0]
    a, b, c = (corners[index, k] for k in range(3))
    px, py = x + 0.5, y + 0.5

    def area(p: np.ndarray, q: np.ndarray, rx: np.ndarray, ry: np.ndarray) -> np.ndarray:
        return (q[:, 0] - p[:, 0]) * (ry - p[:, 1]) - (q[:, 1] - p[:, 1]) * (rx - p[:, 0])

    twice = area(a, b, c[:, 0], c[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.stack([area(b, c, px, py), area(c, a, px, py)], axis=1) / twice[:, None]
        share = np.column_stack([share, 1.0 - share.sum(axis=1)])
    keep = np.flatnonzero((share >= 0.0).all(axis=1))  # not so where a face is seen edge-on: NaN
    share, index, pixel = share[keep], index[keep], (y * width + x)[keep]
    height = (share * corners[index, :, 2]).sum(axis=1)
    np.maximum.at(near, pixel, height)
    front = height == near[pixel]
    face[pixel[front]], weights[pixel[front]] = index[front], share[front]
