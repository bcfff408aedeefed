"""Steps 1 to 5 of the score (method §1), given the faces that rays and nearest points meet."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.closest import ClosestPoints
from mjx_grasp.geometry.mesh import interpolate_normals
from mjx_grasp.geometry.rays import RayHits
from mjx_grasp.geometry.vectors import norm, unit
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.scores import (
    anchor_score,
    coherence_score,
    friction_score,
    separation_score,
    width_score,
)

# Share of the mesh's diagonal.
_LEAST_WIDTH = 1e-6
# Normal of a vertex that has none.
_UP = (0.0, 0.0, 1.0)


class Surfaces(NamedTuple):
    """k meshes, one after the other, as float32; each around the centre of its own box.

    Arrays of NumPy on the host, of JAX on the device.
    """

    vertices: Float[Any, "v 3"]
    """positions [m]"""
    normals: Float[Any, "v 3"]
    """unit, zero where there is none"""
    faces: Int[Any, "f 3"]
    """indices of vertices, counted through all meshes"""
    face_normals: Float[Any, "f 3"]
    """unit, zero where there is none"""
    areas: Float[Any, " f"]
    """zero for padding [m²]"""
    centroids: Float[Any, "f 3"]
    """of the faces [m]"""
    diagonal: Float[Any, " k"]
    """of the bounding box [m]"""
    origin: Float[Any, "k 3"]
    """centre of the box in the frame of the mesh [m]"""


class Masses(NamedTuple):
    """How the mass of k meshes is spread."""

    com: Float[Any, "k 3"]
    """centre of mass, around the centre of the mesh's box [m]"""
    axes: Float[Any, "k 3 3"]
    """principal axes as rows, the longest first"""


class GraspLimits(NamedTuple):
    """What the score asks of a hand."""

    span: Float[Any, " 2"]
    """its narrowest and widest grasp [m]"""
    friction: Float[Any, ""]
    """μ of its description, separate from a scene's [-]"""


class Thumbs(NamedTuple):
    """Vertices of meshes that candidates are asked for."""

    points: Float[Any, "n 3"]
    """positions [m]"""
    normals: Float[Any, "n 3"]
    """unit, zero where there is none"""
    owner: Int[Any, " n"]
    """which mesh each belongs to"""


HeatmapRows = dict[str, Any]
"""What is found for n thumbs: by name the fields of a :class:`..steering.Heatmap` but its vertices,
which are the thumbs, and its score."""


def opposing_contacts(
    surfaces: Surfaces, thumbs: Thumbs, hits: RayHits
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Points o on the faces that were hit, and the normals there (method §1, step 1).

    Where nothing was hit it is the vertex itself: void, but on its own mesh.
    """
    corners = surfaces.vertices[surfaces.faces[hits.face]] * hits.barycentric[:, :, None]
    opposing = corners[:, 0] + corners[:, 1] + corners[:, 2]
    opposing = jnp.where(hits.hit[:, None], opposing, thumbs.points)
    return opposing, interpolate_normals(
        surfaces.normals, surfaces.faces, hits.face, hits.barycentric
    )


def wrap_seeds(
    opposing: Float[Array, "n 3"], long_axis: Float[Array, "n 3"], offsets: tuple[float, ...]
) -> Float[Array, "h 2 n 3"]:
    """Seeds ``o ± h·ℓ`` (method §1, step 3)."""
    h = jnp.asarray(offsets, opposing.dtype)
    sides = jnp.asarray([1.0, -1.0], opposing.dtype)
    return opposing + (h[:, None] * sides)[:, :, None, None] * long_axis


def best_candidates(
    surfaces: Surfaces,
    masses: Masses,
    thumbs: Thumbs,
    hits: RayHits,
    opposing: Float[Array, "n 3"],
    long_axis: Float[Array, "n 3"],
    nearest: ClosestPoints,
    on_mesh: Bool[Array, " m"],
    hand: GraspLimits,
    config: HeatmapConfig,
) -> HeatmapRows:
    """The scores of all offsets, and of each vertex its best (method §1, steps 3 to 5).

    Args:
        surfaces: The meshes.
        masses: Theirs.
        thumbs: Their vertices that candidates are asked for.
        hits: Where the rays from these along −n_t meet them last.
        opposing: Points o.
        long_axis: ℓ there.
        nearest: The seeds of :func:`wrap_seeds` projected to the mesh, in their order.
        on_mesh: Whether there was anything to project them to.
        hand: What does the grasping.
        config: Settings.

    Returns:
        Rows in the frame of their mesh.
    """
    vertices, normals, owner = thumbs
    offsets = jnp.asarray(config.wrap_offsets, vertices.dtype)
    shape = (len(config.wrap_offsets), 2, vertices.shape[0], 3)
    contacts = nearest.point.reshape(shape)
    contact_normals = interpolate_normals(
        surfaces.normals, surfaces.faces, nearest.face, nearest.barycentric
    ).reshape(shape)

    centre = 0.5 * (contacts[:, 0] + contacts[:, 1])
    reach = centre - vertices
    width = norm(reach)
    axis = unit(reach)
    opposition = config.opposition_width
    pushes = friction_score(-axis[:, None], -contact_normals, hand.friction, opposition)
    com = masses.com[owner]
    terms = {
        "width": width_score(width, hand.span, config.narrow_sigma, config.width_sigma),
        "thumb": friction_score(axis, -normals, hand.friction, opposition),
        "wrap": 0.5 * (pushes[:, 0] + pushes[:, 1]),
        "coherence": coherence_score(
            contact_normals[:, 0], contact_normals[:, 1], config.coherence_angle
        ),
        "com": anchor_score(com, vertices, axis, config.com_sigma),
        "separation": separation_score(contacts[:, 0], contacts[:, 1], config.full_separation),
    }
    without_com = (
        terms["width"] * terms["thumb"] * terms["wrap"] * terms["coherence"] * terms["separation"]
    )
    has_normal = jnp.any(normals != 0.0, axis=-1)
    # A shorter axis is rounding: it has no direction.
    least_width = _LEAST_WIDTH * surfaces.diagonal[owner]
    valid = hits.hit & has_normal & (width > least_width)
    valid &= jnp.all(jnp.any(contact_normals != 0.0, axis=-1), axis=1)
    valid &= jnp.all(on_mesh.reshape(shape[:3]), axis=1)
    without_com = jnp.where(valid, without_com, 0.0)

    # argmax takes the first: the smallest h among those that tie with the best.
    scores = without_com * terms["com"]
    ties = scores >= (1.0 - config.tie_tolerance) * jnp.max(scores, axis=0)
    best = jnp.argmax(ties, axis=0)
    rows = jnp.arange(vertices.shape[0])
    kept = valid[best, rows]
    origin = surfaces.origin[owner]
    return dict(
        normals=jnp.where(has_normal[:, None], normals, jnp.asarray(_UP, normals.dtype)),
        score_without_com=without_com[best, rows],
        thumb=vertices + origin,
        opposing=opposing + origin,
        long_axis=long_axis,
        offset=offsets[best],
        wrap=jnp.moveaxis(contacts, 2, 1)[best, rows] + origin[:, None],
        wrap_normals=jnp.moveaxis(contact_normals, 2, 1)[best, rows],
        centre=centre[best, rows] + origin,
        axis=axis[best, rows],
        width=width[best, rows],
        valid=kept,
        terms={name: jnp.where(kept, term[best, rows], 0.0) for name, term in terms.items()},
    )
