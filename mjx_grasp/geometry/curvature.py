"""The local long axis of a surface: the tangent direction along which its normal changes least."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import unit


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
    normal: Float[Array, " 3"], axes: Float[Array, "3 3"], parallel_angle: float
) -> Float[Array, " 3"]:
    """The tangent closest to the first axis that is not within ``parallel_angle`` of the normal.

    Args:
        normal: Unit surface normal.
        axes: Principal axes of the mesh as rows, the longest first.
        parallel_angle: Below this angle to the normal's line an axis has no useful tangent, [rad].
    """
    use_first = jnp.abs(jnp.dot(axes[0], normal)) <= jnp.cos(parallel_angle)
    axis = jnp.where(use_first, axes[0], axes[1])
    return unit(axis - jnp.dot(axis, normal) * normal)


def long_axes(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    centroids: Float[Array, "f 3"],
    face_normals: Float[Array, "f 3"],
    face_areas: Float[Array, " f"],
    axes: Float[Array, "3 3"],
    *,
    radius: float,
    min_faces: int,
    isotropy: float,
    flatness: float,
    parallel_angle: float,
    tile: int = 64,
) -> Float[Array, "n 3"]:
    """Long axis ℓ at surface points (method §1, step 2); unit, its sign means nothing.

    ``C = Σ area_f (n_f − n̄)(n_f − n̄)ᵀ`` over the nearby faces that face the same way, restricted
    to the tangent plane; ℓ is the eigenvector of the smaller eigenvalue. Where C does not single
    out a direction, the tangent closest to a principal axis of the mesh.

    Args:
        points: Surface points in [m].
        normals: Unit normals there.
        centroids: Face centroids in [m].
        face_normals: Unit face normals.
        face_areas: Face areas in [m²]; faces without area take no part.
        axes: Principal axes of the mesh as rows, the longest first.
        radius: Faces with their centroid within this count, [m].
        min_faces: If fewer do, the nearest this many.
        isotropy: Eigenvalues closer than this, relative to the larger one, single out nothing.
        flatness: Nor do two below this share of the area.
        parallel_angle: An axis nearer than this to the normal is passed over, [rad].
        tile: Points worked on at once; bounds the memory to ``tile × f`` numbers.
    """
    # First and second moments of the normals, so that one matrix product sums them all.
    moments = jnp.concatenate(
        [
            jnp.ones_like(face_areas)[:, None],
            face_normals,
            (face_normals[:, :, None] * face_normals[:, None, :]).reshape(-1, 9),
        ],
        axis=1,
    )
    count = min(min_faces, face_areas.shape[0])

    def long_axis(query):
        point, normal = query
        d2 = sum((centroids[:, k] - point[k]) ** 2 for k in range(3))
        alike = sum(face_normals[:, k] * normal[k] for k in range(3)) > 0
        d2 = jnp.where(alike & (face_areas > 0), d2, jnp.inf)
        enough = -jax.lax.top_k(-d2, count)[0][-1]
        near = (d2 <= jnp.maximum(radius * radius, enough)) & jnp.isfinite(d2)
        weights = jnp.where(near, face_areas, 0.0)
        sums = jnp.dot(weights, moments, precision=jax.lax.Precision.HIGHEST)
        area = jnp.where(sums[0] > 0, sums[0], 1.0)
        mean = sums[1:4] / area
        covariance = sums[4:].reshape(3, 3) / area - jnp.outer(mean, mean)

        t1, t2 = tangent_basis(normal)
        c1, c2 = covariance @ t1, covariance @ t2
        a, b, c = jnp.dot(t1, c1), jnp.dot(t1, c2), jnp.dot(t2, c2)
        half = 0.5 * jnp.sqrt((a - c) ** 2 + 4.0 * b * b)
        large, small = 0.5 * (a + c) + half, 0.5 * (a + c) - half
        # Angle of the larger eigenvector from t1; the smaller one is across it.
        angle = 0.5 * jnp.arctan2(2.0 * b, a - c)
        least = jnp.cos(angle) * t2 - jnp.sin(angle) * t1
        undecided = (large - small <= isotropy * large) | (large < flatness)
        return jnp.where(undecided, tangent_reference(normal, axes, parallel_angle), least)

    return jax.lax.map(long_axis, (points, normals), batch_size=tile)
