"""The nearest point on a triangle and on a whole mesh, in tiles of bounded memory."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.vectors import norm


class ClosestPoints(NamedTuple):
    """The nearest surface point of each query.

    Attributes:
        point: ``[n, 3]`` in [m].
        distance: ``[n]`` in [m], unsigned.
        face: ``[n]`` index of the face that holds it (the first of several equally near).
        barycentric: ``[n, 3]`` its weights of the face's vertices.
    """

    point: Float[Array, "n 3"]
    distance: Float[Array, " n"]
    face: Int[Array, " n"]
    barycentric: Float[Array, "n 3"]


def _ratio(numerator, denominator):
    """A ratio in [0, 1] along an edge; 0 on an edge without length."""
    safe = jnp.where(denominator > 0, denominator, 1.0)
    return jnp.where(denominator > 0, jnp.clip(numerator / safe, 0.0, 1.0), 0.0)


def _weights(ap, ab, ac):
    """Barycentric weights (v, w) of the nearest point, and the squared distance.

    Inside where the projection is (the signed areas of Ericson, Real-Time Collision Detection,
    5.1.5), else the nearest of the three edges: that holds for degenerate triangles too, on which
    the choice by Voronoi regions fails. ``ap, ab, ac`` are tuples of components, so that
    everything fuses into one pass.
    """

    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def squared_distance(v, w):
        # Of the remainder vector, not a difference of squares: exact on the surface.
        r = tuple(ap[k] - v * ab[k] - w * ac[k] for k in range(3))
        return dot(r, r)

    ab2, ac2, abac = dot(ab, ab), dot(ac, ac), dot(ab, ac)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    d3, d4 = d1 - ab2, d2 - abac
    d5, d6 = d1 - abac, d2 - ac2
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    inside = (va > 0) & (vb > 0) & (vc > 0)
    inverse = 1.0 / jnp.where(inside, va + vb + vc, 1.0)

    along_bc = _ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    v, w = _ratio(d1, ab2), jnp.zeros_like(d1)
    least = squared_distance(v, w)
    for other_v, other_w in ((0.0 * d2, _ratio(d2, ac2)), (1.0 - along_bc, along_bc)):
        distance = squared_distance(other_v, other_w)
        nearer = distance < least
        v, w = jnp.where(nearer, other_v, v), jnp.where(nearer, other_w, w)
        least = jnp.where(nearer, distance, least)
    v, w = jnp.where(inside, vb * inverse, v), jnp.where(inside, vc * inverse, w)
    return v, w, jnp.where(inside, squared_distance(v, w), least)


def _components(x):
    return x[..., 0], x[..., 1], x[..., 2]


def closest_on_triangle(
    point: Float[Array, "*batch 3"], triangle: Float[Array, "*batch 3 3"]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """The nearest point of a triangle and its barycentric weights; finite on degenerate ones."""
    a = triangle[..., 0, :]
    ab, ac = triangle[..., 1, :] - a, triangle[..., 2, :] - a
    v, w, _ = _weights(_components(point - a), _components(ab), _components(ac))
    nearest = a + v[..., None] * ab + w[..., None] * ac
    return nearest, jnp.stack([1.0 - v - w, v, w], axis=-1)


def closest_on_mesh(
    points: Float[Array, "n 3"], triangles: Float[Array, "f 3 3"], tile: int = 64
) -> ClosestPoints:
    """The nearest point of a mesh to each query (method §1, step 3), over all faces.

    Args:
        points: Queries in [m].
        triangles: Corners of the faces in [m].
        tile: Queries worked on at once; bounds the memory to ``tile × f`` numbers.
    """
    corner = triangles[:, 0]
    ab, ac = _components(triangles[:, 1] - corner), _components(triangles[:, 2] - corner)

    def nearest_face(point):
        return jnp.argmin(_weights(_components(point - corner), ab, ac)[2])

    face = jax.lax.map(nearest_face, points, batch_size=tile)
    point, barycentric = closest_on_triangle(points, triangles[face])
    return ClosestPoints(point, norm(points - point), face, barycentric)
