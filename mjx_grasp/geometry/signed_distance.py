"""Signed distances to shapes, with their gradients: exact for primitives, sampled for meshes.

A shape is a pytree of arrays, so that a batch of them, each of another size, is a ``vmap``. Its
frame is the object's; distances are negative inside; the gradient is the outward unit normal of
the nearest surface point (any one of them where several are equally near).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.loops import sum_over
from mjx_grasp.geometry.vectors import dot, unit

# Below this length in [m] a direction is rounding, and a fixed one is taken.
_SHORT = 1e-9


class Sphere(NamedTuple):
    """A ball about the origin.

    Attributes:
        radius: In [m].
    """

    radius: Float[Array, ""]


class Cylinder(NamedTuple):
    """A solid cylinder about the z axis.

    Attributes:
        radius: In [m].
        half_length: From the origin to either end face, [m].
    """

    radius: Float[Array, ""]
    half_length: Float[Array, ""]


class Box(NamedTuple):
    """A solid box about the origin.

    Attributes:
        half: ``[3]`` half extents in [m].
    """

    half: Float[Array, " 3"]


class DistanceField(NamedTuple):
    """Distances to a mesh on a regular grid, between which they are interpolated.

    Beyond the grid the distance to its border is added: at least the true distance to the surface
    but for the grid's own error, and more by up to twice the distance to the border. Clearances
    therefore have to be less than the grid reaches beyond the mesh.

    Attributes:
        values: ``[nx, ny, nz]`` in [m].
        origin: ``[3]`` the first grid point, [m].
        spacing: Between grid points, the same along all axes, [m].
    """

    values: Float[Array, "nx ny nz"]
    origin: Float[Array, " 3"]
    spacing: Float[Array, ""]


Shape = Sphere | Cylinder | Box | DistanceField


def signed_distance(shape: Shape, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Distance in [m] of points of the shape's frame to its surface, negative inside."""
    return distance_and_normal(shape, points)[0]


def distance_and_normal(
    shape: Shape, points: Float[Array, "*n 3"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n 3"]]:
    """Signed distance in [m] and its gradient, of unit length for primitives.

    Args:
        shape: What to stay away from.
        points: In the shape's frame, [m].
    """
    match shape:
        case Sphere():
            return _to_point(points, shape.radius)
        case Cylinder():
            return _to_cylinder(points, shape)
        case Box():
            return _to_box(points, shape)
        case DistanceField():
            return _interpolated(points, shape)


def _to_point(
    offset: Float[Array, "*n 3"], radius: Float[Array, ""]
) -> tuple[Float[Array, "*n"], Float[Array, "*n 3"]]:
    squared = dot(offset, offset)
    known = squared > _SHORT**2
    length = jnp.sqrt(jnp.where(known, squared, 1.0))
    up = jnp.asarray([0.0, 0.0, 1.0], offset.dtype)
    normal = jnp.where(known[..., None], offset / length[..., None], up)
    return jnp.where(known, length, 0.0) - radius, normal


def _rounded(
    first: Float[Array, "*n"], second: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Distance from a quarter-plane corner, given distances beyond its two sides, and weights."""
    outside_first, outside_second = jnp.maximum(first, 0.0), jnp.maximum(second, 0.0)
    squared = outside_first**2 + outside_second**2
    corner = (first > 0) & (second > 0)
    length = jnp.sqrt(jnp.where(corner, squared, 1.0))
    larger = first > second
    distance = jnp.where(corner, length, jnp.maximum(first, second))
    w_first = jnp.where(corner, outside_first / length, jnp.where(larger, 1.0, 0.0))
    w_second = jnp.where(corner, outside_second / length, jnp.where(larger, 0.0, 1.0))
    return distance, w_first, w_second


def _to_cylinder(
    points: Float[Array, "*n 3"], shape: Cylinder
) -> tuple[Float[Array, "*n"], Float[Array, "*n 3"]]:
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    squared = x * x + y * y
    known = squared > _SHORT**2
    rho = jnp.sqrt(jnp.where(known, squared, 1.0))
    beyond_side = jnp.where(known, rho, 0.0) - shape.radius
    beyond_end = jnp.abs(z) - shape.half_length
    distance, side, end = _rounded(beyond_side, beyond_end)
    normal = jnp.stack(
        [
            side * jnp.where(known, x / rho, 1.0),
            side * jnp.where(known, y / rho, 0.0),
            end * jnp.where(z < 0, -1.0, 1.0),
        ],
        axis=-1,
    )
    return distance, normal


def _to_box(
    points: Float[Array, "*n 3"], shape: Box
) -> tuple[Float[Array, "*n"], Float[Array, "*n 3"]]:
    beyond = jnp.abs(points) - shape.half
    sign = jnp.where(points < 0, -1.0, 1.0)
    outside = jnp.maximum(beyond, 0.0)
    squared = dot(outside, outside)
    is_outside = squared > 0
    length = jnp.sqrt(jnp.where(is_outside, squared, 1.0))
    nearest_face = jax.nn.one_hot(jnp.argmax(beyond, axis=-1), 3, dtype=points.dtype)
    normal = jnp.where(is_outside[..., None], outside / length[..., None], nearest_face)
    return jnp.where(is_outside, length, jnp.max(beyond, axis=-1)), sign * normal


def _interpolated(
    points: Float[Array, "*n 3"], shape: DistanceField
) -> tuple[Float[Array, "*n"], Float[Array, "*n 3"]]:
    """Trilinear, with the gradient of the interpolation itself."""
    cells, shares, beyond = [], [], []
    for axis, count in enumerate(shape.values.shape):
        place = (points[..., axis] - shape.origin[axis]) / shape.spacing
        inside = jnp.clip(place, 0.0, count - 1.0)
        cells.append(jnp.minimum(inside.astype(jnp.int32), count - 2))
        shares.append(inside - cells[-1])
        beyond.append((place - inside) * shape.spacing)

    def of_corner(number: Int[Array, ""]) -> tuple[Array, ...]:
        which = number // 4, number // 2 % 2, number % 2
        found = shape.values[tuple(c + w for c, w in zip(cells, which, strict=True))]
        x, y, z = (jnp.where(w == 1, t, 1.0 - t) for w, t in zip(which, shares, strict=True))
        dx, dy, dz = (2.0 * w - 1.0 for w in which)
        parts = x * y * z, dx * y * z, x * dy * z, x * y * dz
        return tuple(part * found for part in parts)

    value, *slope = sum_over(8, of_corner)
    slope = [part / shape.spacing for part in slope]
    squared = beyond[0] ** 2 + beyond[1] ** 2 + beyond[2] ** 2
    outside = squared > 0
    gap = jnp.sqrt(jnp.where(outside, squared, 1.0))
    # Outside the grid the way back to it leads to the surface, nearly enough.
    over = jnp.maximum(value, 0.0)
    towards = unit(jnp.stack([s * over + b for s, b in zip(slope, beyond, strict=True)], axis=-1))
    normal = jnp.where(outside[..., None], towards, jnp.stack(slope, axis=-1))
    return value + jnp.where(outside, gap, 0.0), normal
