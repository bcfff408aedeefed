"""The local long axis of a surface: the tangent direction along which its normal changes least."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.tiles import map_tiles, tile_for
from mjx_grasp.geometry.vectors import dot, unit

# Relative difference of squared distances below which they are the same.
SAME_DISTANCE = 3e-7
# Cosine below which a face is square to a normal, up to rounding.
SQUARE = 1e-5


def tangent_basis(
    normal: Float[Array, "*batch 3"],
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """Two unit vectors that span the plane across a unit normal (Duff et al., 2017)."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    t1 = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    t2 = jnp.stack([b, sign + y * y * a, -y], axis=-1)
    return t1, t2


def tangent_reference(
    normal: Float[Array, "*batch 3"], axes: Float[Array, "*#batch 3 3"], parallel_angle: float
) -> Float[Array, "*batch 3"]:
    """The tangent closest to the first axis that is not within ``parallel_angle`` of the normal.

    Args:
        normal: Unit surface normal.
        axes: Principal axes of the mesh as rows, the longest first.
        parallel_angle: Below this angle to the normal's line an axis has no useful tangent, [rad].
    """
    first, second = axes[..., 0, :], axes[..., 1, :]
    use_first = jnp.abs(dot(first, normal)) <= jnp.cos(parallel_angle)
    axis = jnp.where(use_first[..., None], first, second)
    return unit(axis - dot(axis, normal)[..., None] * normal)


def normal_spread(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    centroids: Float[Array, "f 3"],
    face_normals: Float[Array, "f 3"],
    face_areas: Float[Array, " f"],
    *,
    radius: float,
    min_faces: int,
    tile: int | None = None,
) -> Float[Array, "n 3"]:
    """Spread of the normals around surface points (method §1, step 2): C over the area.

    ``C = Σ area_f (n_f − n̄)(n_f − n̄)ᵀ`` over the nearby faces that face the same way, restricted
    to the tangent plane. What hangs on rounding in exact shapes is settled: a face at the radius
    itself counts, as do all that are as near as the last one, and a face square to the normal does
    not face the same way.

    Args:
        points: Surface points in [m].
        normals: Unit normals there.
        centroids: Face centroids in [m].
        face_normals: Unit face normals.
        face_areas: Face areas in [m²]; faces without area take no part.
        radius: Faces with their centroid within this count, [m].
        min_faces: If fewer do, the nearest this many.
        tile: Points worked on at once; bounds the memory to a few times ``tile × f`` numbers. As
            the device likes it if None.

    Returns:
        C's entries (1,1), (1,2) and (2,2) in the basis of :func:`tangent_basis`, over the area.
    """
    count = min(min_faces, face_areas.shape[0])

    def along(direction: Float[Array, "m 3"]) -> Float[Array, "m f"]:
        each = (direction[:, k, None] * face_normals[None, :, k] for k in range(3))
        return sum(each, start=jnp.zeros((), direction.dtype))

    def spread(point: Float[Array, "m 3"], normal: Float[Array, "m 3"]) -> Float[Array, "m 3"]:
        squared = sum((centroids[None, :, k] - point[:, k, None]) ** 2 for k in range(3))
        alike = (along(normal) > SQUARE) & (face_areas > 0)
        squared = jax.lax.optimization_barrier(jnp.where(alike, squared, jnp.inf))

        def enough(reach: Float[Array, " m"]) -> Bool[Array, " m"]:
            return jnp.sum(squared <= reach[:, None], axis=1) >= count

        def farther(
            state: tuple[Float[Array, " m"], Bool[Array, " m"]],
        ) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
            reach, _ = state
            beyond = jnp.where(squared > reach[:, None], squared, jnp.inf)
            wider = (1.0 + SAME_DISTANCE) * jnp.min(beyond, axis=1)
            reach = jnp.where(enough(reach) | ~jnp.isfinite(wider), reach, wider)
            return reach, enough(reach) | ~jnp.isfinite(wider)

        reach = jnp.full(point.shape[0], (1.0 + SAME_DISTANCE) * radius**2, point.dtype)
        reach, _ = jax.lax.while_loop(
            lambda state: ~jnp.all(state[1]), farther, (reach, enough(reach))
        )
        weights = jnp.where(squared <= reach[:, None], face_areas, 0.0)
        weights = jax.lax.optimization_barrier(weights)
        area = jnp.sum(weights, axis=1)
        scale = jnp.where(area > 0, 1.0 / jnp.where(area > 0, area, 1.0), 0.0)
        # About the mean, along tangents: a difference of large moments would cancel on flat parts.
        offsets = []
        for tangent in tangent_basis(normal):
            component = along(tangent)
            mean = scale * jnp.sum(weights * component, axis=1)
            offsets.append(component - mean[:, None])
        x, y = offsets
        return jnp.stack(
            [scale * jnp.sum(weights * p, axis=1) for p in (x * x, x * y, y * y)], axis=1
        )

    return map_tiles(spread, (points, normals), tile or tile_for(face_areas.shape[0]))


def axes_of_spread(
    spread: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    axes: Float[Array, "*n 3 3"],
    *,
    isotropy: float,
    flatness: float,
    parallel_angle: float,
) -> Float[Array, "n 3"]:
    """Long axis ℓ (method §1, step 2): eigenvector of the smaller eigenvalue of C; unit.

    Where C does not single out a direction, the tangent closest to a principal axis of the mesh.

    Args:
        spread: See :func:`normal_spread`.
        normals: Unit normals there.
        axes: Principal axes of the mesh as rows, the longest first; of one mesh or per point.
        isotropy: Eigenvalues closer than this, relative to the larger one, single out nothing.
        flatness: Nor do two below this share of the area.
        parallel_angle: An axis nearer than this to the normal is passed over, [rad].
    """
    a, b, c = spread[:, 0], spread[:, 1], spread[:, 2]
    half = 0.5 * jnp.sqrt((a - c) ** 2 + 4.0 * b * b)
    large = 0.5 * (a + c) + half
    undecided = (2.0 * half <= isotropy * large) | (large < flatness)
    # Angle of the larger eigenvector from the first tangent; the smaller one is across it.
    angle = 0.5 * jnp.arctan2(2.0 * b, a - c)[:, None]
    first, second = tangent_basis(normals)
    least = jnp.cos(angle) * second - jnp.sin(angle) * first
    reference = tangent_reference(normals, axes, parallel_angle)
    return jnp.where(undecided[:, None], reference, least)
