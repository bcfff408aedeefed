"""The nearest point on a triangle and on a whole mesh, in tiles of bounded memory."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.components import Components, Scalars, components, cross, dot
from mjx_grasp.geometry.tiles import first_least, map_tiles, tile_for
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


def _ratio(numerator: Scalars, denominator: Scalars) -> Scalars:
    """A ratio in [0, 1] along an edge; 0 on an edge without length."""
    safe = jnp.where(denominator > 0, denominator, 1.0)
    return jnp.where(denominator > 0, jnp.clip(numerator / safe, 0.0, 1.0), 0.0)


def _duals(ab: Components, ac: Components) -> tuple[Components, Components]:
    """Vectors whose inner product with a point, from the corner, is its weight v or w.

    ``ac × n / |n|²`` and ``n × ab / |n|²``: on a sliver they lose as many digits as it is longer
    than wide, where the usual quotient of determinants of inner products loses twice as many.
    Zero for a degenerate triangle.
    """
    normal = cross(ab, ac)
    squared = dot(normal, normal)
    inverse = _inverse(squared)
    to_v, to_w = cross(ac, normal), cross(normal, ab)
    return tuple(c * inverse for c in to_v), tuple(c * inverse for c in to_w)


def _inverse(squared: Scalars) -> Scalars:
    """0 for an edge without length."""
    return jnp.where(squared > 0, 1.0 / jnp.where(squared > 0, squared, 1.0), 0.0)


class _Faces(NamedTuple):
    """Triangles, and all that hangs on them alone: worked out once, not for every query."""

    a: Components
    """first corner"""
    ab: Components
    ac: Components
    bc: Components
    to_v: Components
    """see :func:`_duals`"""
    to_w: Components
    inverse_ab: Scalars
    """over the squared length"""
    inverse_ac: Scalars
    inverse_bc: Scalars


def _faces_of(triangles: Float[Array, "f 3 3"]) -> _Faces:
    corner = triangles[:, 0]
    ab, ac = (components(triangles[:, k] - corner) for k in (1, 2))
    bc = tuple(c - b for b, c in zip(ab, ac, strict=True))
    inverses = (_inverse(dot(e, e)) for e in (ab, ac, bc))
    return _Faces(components(corner), ab, ac, bc, *_duals(ab, ac), *inverses)


def _squared_distance(p: Components, faces: _Faces) -> Scalars:
    """To a triangle: see :func:`_weights`."""
    a, ab, ac, bc, to_v, to_w, inverse_ab, inverse_ac, inverse_bc = faces

    def to_edge(from_corner: Components, edge: Components, inverse: Scalars) -> Scalars:
        along = jnp.clip(dot(from_corner, edge) * inverse, 0.0, 1.0)
        r = tuple(x - along * e for x, e in zip(from_corner, edge, strict=True))
        return dot(r, r)

    ap = tuple(x - y for x, y in zip(p, a, strict=True))
    bp = tuple(x - y for x, y in zip(ap, ab, strict=True))
    edges = jnp.minimum(to_edge(ap, ab, inverse_ab), to_edge(ap, ac, inverse_ac))
    edges = jnp.minimum(edges, to_edge(bp, bc, inverse_bc))
    v, w = dot(ap, to_v), dot(ap, to_w)
    r = tuple(x - v * y - w * z for x, y, z in zip(ap, ab, ac, strict=True))
    return jnp.where((v > 0) & (w > 0) & (v + w < 1), dot(r, r), edges)


def _weights(
    ap: Components, ab: Components, ac: Components, to_v: Components, to_w: Components
) -> Float[Array, "*batch 3"]:
    """Barycentric weights of the nearest point.

    Inside where the projection is, else the nearest of the three edges: that holds for degenerate
    triangles too, on which a choice by Voronoi regions fails. All three weights are chosen as one:
    XLA may compute a choice twice with other rounding, and so mix the weights of a tie.
    """

    def weights(v: Scalars, w: Scalars) -> Float[Array, "*batch 3"]:
        return jnp.stack([1.0 - v - w, v, w], axis=-1)

    def squared_distance(v: Scalars, w: Scalars) -> Scalars:
        # Of the remainder vector, not a difference of squares: exact on the surface.
        r = tuple(ap[k] - v * ab[k] - w * ac[k] for k in range(3))
        return dot(r, r)

    inside_v, inside_w = dot(ap, to_v), dot(ap, to_w)
    inside = (inside_v > 0) & (inside_w > 0) & (inside_v + inside_w < 1)

    ab2, ac2, abac = dot(ab, ab), dot(ac, ac), dot(ab, ac)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    along_bc = _ratio((d2 - abac) - (d1 - ab2), ab2 + ac2 - 2.0 * abac)
    on_ab = _ratio(d1, ab2), jnp.zeros_like(d1)
    chosen, least = weights(*on_ab), squared_distance(*on_ab)
    for other in ((0.0 * d2, _ratio(d2, ac2)), (1.0 - along_bc, along_bc)):
        distance = squared_distance(*other)
        nearer = distance < least
        chosen = jnp.where(nearer[..., None], weights(*other), chosen)
        least = jnp.where(nearer, distance, least)
    return jnp.where(inside[..., None], weights(inside_v, inside_w), chosen)


def closest_on_triangle(
    point: Float[Array, "*batch 3"], triangle: Float[Array, "*batch 3 3"]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """The nearest point of a triangle and its barycentric weights; finite on degenerate ones."""
    a = triangle[..., 0, :]
    ab, ac = triangle[..., 1, :] - a, triangle[..., 2, :] - a
    sides = components(ab), components(ac)
    weights = _weights(components(point - a), *sides, *_duals(*sides))
    return a + weights[..., 1:2] * ab + weights[..., 2:] * ac, weights


def closest_on_mesh(
    points: Float[Array, "n 3"], triangles: Float[Array, "f 3 3"], tile: int | None = None
) -> ClosestPoints:
    """The nearest point of a mesh to each query (method §1, step 3), over all faces.

    Args:
        points: Queries in [m].
        triangles: Corners of the faces in [m].
        tile: Queries worked on at once; bounds the memory to ``tile × f`` numbers. As the device
            likes it if None.
    """
    faces = jax.tree.map(lambda x: x[None], jax.lax.optimization_barrier(_faces_of(triangles)))

    def nearest_face(point: Float[Array, "m 3"]) -> Int[Array, " m"]:
        return first_least(_squared_distance(components(point[:, None]), faces))

    face = map_tiles(nearest_face, (points,), tile or tile_for(triangles.shape[0]))
    return closest_on_face(points, triangles, face)


def closest_on_face(
    points: Float[Array, "n 3"], triangles: Float[Array, "f 3 3"], face: Int[Array, " n"]
) -> ClosestPoints:
    """The nearest point of the face that is named for each query."""
    point, barycentric = closest_on_triangle(points, triangles[face])
    return ClosestPoints(point, norm(points - point), face, barycentric)
