"""The pinhole camera: pixels, rays and depths.

Pixel coordinates are continuous: pixel (column k, row l) covers [k, k+1) × [l, l+1), its centre
is (k + 0.5, l + 0.5), the picture's middle is (width/2, height/2). The camera's own axes are
x right, y down, z forward; depth is measured along z, not along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """Intrinsics [pixels] and pose of a camera without distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    R_wc: Float[np.ndarray, "3 3"]
    """Columns: the camera's x (right), y (down) and z (forward) in the world."""
    p_wc: Float[np.ndarray, " 3"]
    """Its centre in the world [m]."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError("camera size", (self.width, self.height), "positive numbers of pixels")
        if not (self.fx > 0 and self.fy > 0):
            raise InputError("focal lengths", (self.fx, self.fy), "positive numbers of pixels")
        rotation = np.asarray(self.R_wc)
        if rotation.shape != (3, 3) or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-5):
            raise InputError("R_wc", rotation, "a rotation matrix [3, 3]")

    def contains(self, pixel: Float[np.ndarray, " 2"]) -> bool:
        """Whether a pixel coordinate lies in the picture, its right and bottom edge included."""
        x, y = pixel
        return bool(0 <= x <= self.width and 0 <= y <= self.height)

    def ray(
        self, pixel: Float[np.ndarray, " 2"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Origin [m] and unit direction in the world of the ray through a pixel coordinate."""
        direction = self.R_wc @ self._direction(pixel)
        return np.asarray(self.p_wc, np.float64), direction / np.linalg.norm(direction)

    def back_project(self, pixel: Float[np.ndarray, " 2"], depth: float) -> Float[np.ndarray, " 3"]:
        """The world point [m] at a depth along the optical axis [m] behind a pixel coordinate."""
        return self.p_wc + self.R_wc @ (depth * self._direction(pixel))

    def project(
        self, points: Float[np.ndarray, "*n 3"]
    ) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray | np.floating, "*n"]]:
        """Pixel coordinates and depths [m] of world points; meaningful in front of the camera."""
        x, y, z = np.moveaxis((np.asarray(points) - self.p_wc) @ self.R_wc, -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1), z

    def _direction(self, pixel: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " 3"]:
        x, y = pixel
        return np.array([(x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0])
