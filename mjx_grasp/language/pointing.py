"""From a pixel that was pointed at to an anchor on the object (method §1, language)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from mjx_grasp.geometry.closest import closest_on_triangle
from mjx_grasp.language.grounding import Anchor, GroundingError, Target, View

LIMIT_M = 0.03
"""How far beside the object a ray may pass [m]: about a fingertip's width and a half."""
TOLERANCE_M = 0.01
"""How far measured depth may be from the mesh and still be the object [m]."""


class RayPoint(NamedTuple):
    """Where a ray meets a mesh, or passes it.

    Attributes:
        point: ``[3]`` the surface point, m.
        along: Its distance along the ray, m.
        beside: Its distance from the ray, m; 0 for a hit.
    """

    point: np.ndarray
    along: float
    beside: float


def anchor_at(
    instruction: str,
    pixel: Real[np.ndarray, " 2"],
    target: Target,
    limit: float = LIMIT_M,
) -> Anchor:
    """The anchor that a pixel of the target's view means.

    The measured depth gives the point, if there is a depth and the point lies on the object.
    Otherwise the object's known pose helps out: where depth is missing, or goes through the object
    (glass, holes in the depth image), the first surface along the ray is taken; where the ray
    passes beside the object, the nearest surface within the limit.

    Args:
        instruction: What was asked for; for errors.
        pixel: Pixel coordinates (x, y), see :mod:`mjx_grasp.language.camera`; the centre of that
            pixel is taken.
        target: The object with the view that the pixel belongs to.
        limit: How far beside the object the ray may pass [m].

    Raises:
        GroundingError: There is no view, the pixel is outside the picture, something else is in
            front of the object there, or the ray passes too far beside the object.
    """
    view = target.view
    if view is None:
        raise GroundingError(instruction, "no picture of the object", "a target with a view")
    _check(view, instruction)
    pixel = np.asarray(pixel, np.float64)
    place = f"pixel ({pixel[0]:.1f}, {pixel[1]:.1f})"
    if not view.camera.contains(pixel):
        size = f"{view.camera.width}×{view.camera.height}"
        raise GroundingError(instruction, f"{place} outside the picture", f"a pixel of {size}")
    # Depth is measured at pixels' centres; between them, a step of the surface would mislead.
    pixel = np.minimum(np.floor(pixel), [view.camera.width - 1, view.camera.height - 1]) + 0.5
    origin, direction = view.camera.ray(pixel)
    met = along_ray(
        target.vertices, target.faces, _in_object(origin, view), view.R_wo.T @ direction
    )
    depth = depth_at(view.depth, pixel)
    if depth is not None:
        measured = _in_object(view.camera.back_project(pixel, depth), view)
        if distance_to_mesh(target, measured) <= TOLERANCE_M:
            return Anchor(measured, f"{place}, depth {depth:.3f} m")
        # Beside the object, what is nearer may well be the table in front of it.
        nearer = np.linalg.norm(measured - _in_object(origin, view)) < met.along - TOLERANCE_M
        if met.beside == 0.0 and nearer:
            raise GroundingError(
                instruction,
                f"something at {depth:.3f} m in front of {target.name} at {place}",
                f"the object at {met.along:.3f} m there",
            )
    if met.beside > limit:
        raise GroundingError(
            instruction,
            f"{place} passes {target.name} at {1e3 * met.beside:.0f} mm",
            f"a pixel on the object, or within {1e3 * limit:.0f} mm of it",
        )
    how = "the mesh" if met.beside == 0.0 else f"the mesh, {1e3 * met.beside:.1f} mm beside"
    return Anchor(met.point, f"{place}, {how}")


def depth_at(depth: Float[np.ndarray, "h w"], pixel: Float[np.ndarray, " 2"]) -> float | None:
    """The depth [m] of the pixel that a coordinate lies in; None where it was not measured."""
    height, width = depth.shape
    value = float(depth[min(int(pixel[1]), height - 1), min(int(pixel[0]), width - 1)])
    return value if np.isfinite(value) and value > 0.0 else None


def along_ray(
    vertices: Float[np.ndarray, "v 3"],
    faces: np.ndarray,
    origin: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
) -> RayPoint:
    """The first surface point that a ray hits, or else the one that it passes nearest.

    In the projection along the ray, the ray is a point: the nearest point of every projected
    triangle to it has the same barycentric weights as the surface point sought.

    Args:
        vertices: Of the mesh [m].
        faces: Vertex indices [f, 3].
        origin: Of the ray, in the mesh's frame [m].
        direction: Unit.
    """
    offset = np.asarray(vertices, np.float64) - origin
    along = offset @ direction
    across = offset - along[:, None] * direction
    corners = across[faces]
    nearest, weights = _nearest_to_origin(corners)
    beside = np.linalg.norm(nearest, axis=1)
    at = (weights * along[faces]).sum(axis=1)
    beside[at <= 0.0] = np.inf  # behind the camera
    rounding = 1e-6
    among = np.flatnonzero(beside <= beside.min() + rounding)
    face = int(among[np.argmin(at[among])])
    point = (weights[face][:, None] * vertices[faces[face]]).sum(axis=0)
    hit = beside[face] <= rounding
    return RayPoint(point, float(at[face]), 0.0 if hit else float(beside[face]))


def distance_to_mesh(target: Target, point: Float[np.ndarray, " 3"]) -> float:
    """Distance from a point of the object frame to the object's surface [m]."""
    corners = np.asarray(target.vertices, np.float64)[target.faces] - point
    nearest, _ = _nearest_to_origin(corners)
    return float(np.linalg.norm(nearest, axis=1).min())


def _nearest_to_origin(
    corners: Float[np.ndarray, "f 3 3"],
) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f 3"]]:
    """Of each triangle, the point nearest to the origin and its barycentric weights."""
    point, weights = closest_on_triangle(
        jnp.zeros((len(corners), 3)), jnp.asarray(corners, jnp.float32)
    )
    return np.asarray(point, np.float64), np.asarray(weights, np.float64)


def _in_object(point_w: Float[np.ndarray, " 3"], view: View) -> Float[np.ndarray, " 3"]:
    return view.R_wo.T @ (point_w - view.p_wo)


def _check(view: View, instruction: str) -> None:
    size = (view.camera.height, view.camera.width)
    if view.image.shape[:2] != size or view.depth.shape != size:
        found = f"a picture {view.image.shape} with depth {view.depth.shape}"
        raise GroundingError(instruction, found, f"both of the camera's size {size}")
