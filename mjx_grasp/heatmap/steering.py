"""Re-weighting a cached heatmap by an anchor point."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import dot
from mjx_grasp.heatmap.scores import anchor_score


class Heatmap(NamedTuple):
    """Grasp candidates of one mesh, one per vertex, in the object frame.

    Everything is finite; where ``valid`` is False the scores are 0 and the geometry is void.

    Attributes:
        vertices: ``[v, 3]`` thumb-side surface points p_t in [m].
        normals: ``[v, 3]`` outward unit normals there, n_t.
        score: ``[v]`` S, with the centre-of-mass term.
        score_without_com: ``[v]`` S without it: what steering starts from.
        thumb: ``[v, 3]`` thumb contact; the vertex itself.
        opposing: ``[v, 3]`` farthest hit o of the ray from the vertex along −n_t.
        long_axis: ``[v, 3]`` unit local long axis ℓ at o.
        offset: ``[v]`` wrap offset h that was kept, [m].
        wrap: ``[v, 2, 3]`` wrap contacts c_1, c_2.
        wrap_normals: ``[v, 2, 3]`` outward unit normals there.
        centre: ``[v, 3]`` centroid c of the wrap contacts.
        axis: ``[v, 3]`` unit grasp axis g, from the thumb to c.
        width: ``[v]`` w = |c − p_t| in [m].
        valid: ``[v]`` whether there is a candidate at all.
        terms: ``[v]`` each, the factors of S: ``width, thumb, wrap, coherence, com, separation``.
    """

    vertices: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    score: Float[Array, " v"]
    score_without_com: Float[Array, " v"]
    thumb: Float[Array, "v 3"]
    opposing: Float[Array, "v 3"]
    long_axis: Float[Array, "v 3"]
    offset: Float[Array, " v"]
    wrap: Float[Array, "v 2 3"]
    wrap_normals: Float[Array, "v 2 3"]
    centre: Float[Array, "v 3"]
    axis: Float[Array, "v 3"]
    width: Float[Array, " v"]
    valid: Bool[Array, " v"]
    terms: dict[str, Float[Array, " v"]]


@jax.jit
def weigh(
    score_without_com: Float[Array, " v"],
    thumb: Float[Array, "v 3"],
    axis: Float[Array, "v 3"],
    anchor: Float[Array, " 3"],
    sigma: Float[Array, ""] | float,
) -> Float[Array, " v"]:
    """``S^a = S_without_COM · exp(−(d⊥(a, i)/σ_a)²)`` (method §1, steering).

    Compiled on its own and used for the default score too, so that steering to the centre of mass
    gives the default heatmap bit for bit.
    """
    return score_without_com * anchor_score(anchor, thumb, axis, sigma)


def steer(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    sigma: Float[Array | np.ndarray | np.floating, ""] | float = 0.030,
) -> Float[Array, " v"]:
    """Scores of a heatmap's candidates for an anchor; for many anchors see :func:`steer_many`.

    The anchor and σ may change at every call: nothing is compiled again.

    Args:
        heatmap: Cached candidates.
        anchor: Point in the object frame, [m].
        sigma: Distance from the anchor to the grasp axis at which a score falls to 1/e, [m].

    Raises:
        InputError: The anchor is not one point.
    """
    dtype = heatmap.score_without_com.dtype
    anchor, sigma = jnp.asarray(anchor, dtype), jnp.asarray(sigma, dtype)
    if anchor.shape != (3,):
        raise InputError("anchor", f"shape {anchor.shape}", "one point [3] in m")
    return weigh(heatmap.score_without_com, heatmap.thumb, heatmap.axis, anchor, sigma)


def steer_many(
    heatmap: Heatmap,
    anchors: Float[Array | np.ndarray, "a 3"],
    sigma: Float[Array | np.ndarray, "*a"] | float = 0.030,
) -> Float[Array, "a v"]:
    """Scores for many anchors at once, as :func:`steer` gives them one by one.

    Args:
        heatmap: Cached candidates.
        anchors: Points in the object frame, [m].
        sigma: Of all anchors, or of each, [m].

    Raises:
        InputError: The anchors are not points.
    """
    dtype = heatmap.score_without_com.dtype
    anchors = jnp.asarray(anchors, dtype)
    if anchors.ndim != 2 or anchors.shape[1] != 3:
        raise InputError("anchors", f"shape {anchors.shape}", "points [a, 3] in m")
    sigma = jnp.broadcast_to(jnp.asarray(sigma, dtype), anchors.shape[:1])
    return _weigh_many(heatmap.score_without_com, heatmap.thumb, heatmap.axis, anchors, sigma)


_weigh_many = jax.jit(jax.vmap(weigh, in_axes=(None, None, None, 0, 0)))


@jax.jit
def steer_near(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    sigma: Float[Array, ""] | float = 0.030,
) -> Float[Array, " v"]:
    """Scores for an anchor that should lie between the contacts; an addition to the method.

    The publication's factor (:func:`steer`) measures the anchor's distance d⊥
    from the grasp axis, which is a line: a grasp at the other end of the object keeps its score
    where the line happens to meet the anchor. Here it is multiplied by ``exp(−(e/σ)²)``, with e how
    far along the axis the anchor lies beyond the contacts, 0 between them. With
    ``d² = d⊥² + e²``, that is the distance from the anchor to the segment between the contacts.

    Args:
        heatmap: Cached candidates.
        anchor: Point in the object frame, [m].
        sigma: Distance to the segment at which a score falls to 1/e, [m].
    """
    along = dot(jnp.asarray(anchor) - heatmap.thumb, heatmap.axis)
    beyond = jnp.maximum(jnp.maximum(-along, along - heatmap.width), 0.0)
    return steer(heatmap, anchor, sigma) * jnp.exp(-((beyond / sigma) ** 2))


def steer_to(
    heatmap: Heatmap, anchor: Float[Array | np.ndarray, " 3"], sigma: float, between_contacts: bool
) -> Float[Array, " v"]:
    """Scores for an anchor: in line with the contacts (`steer`) or between them (`steer_near`).

    Args:
        heatmap: Cached candidates.
        anchor: Point in the object frame [m].
        sigma: Distance at which a score falls to 1/e [m].
        between_contacts: Whether the anchor should lie between the contacts.
    """
    return (steer_near if between_contacts else steer)(heatmap, anchor, sigma)
