"""Re-weighting a cached heatmap by an anchor: a point, or a part of the object."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import dot, norm
from mjx_grasp.heatmap.scores import anchor_score

Steering = Literal["contacts", "axis", "between"]
"""What has to be near the anchor: all three contacts (:func:`steer_contacts`), the grasp axis, as
published (:func:`steer`), or the middle of the grasp (:func:`steer_near`)."""

Sigma = Float[Array | np.ndarray | np.floating, ""] | float
"""Distance from an anchor at which a score falls to 1/e [m]."""

SIGMA_M = 0.030
"""Scale of the distance to an anchor that is a point [m]."""
_PART_SHARE = 0.125  # larger, and better grasps beside a thin part come into the choice
_LEAST_SIGMA_M = 0.002  # scans are not more accurate
_TAIL = 1e-9  # far scores fall slowly from here: of two, the nearer one is still to be preferred


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
    sigma: Sigma = SIGMA_M,
) -> Float[Array, " v"]:
    """Scores of a heatmap's candidates for an anchor; for many anchors see :func:`steer_many`.

    The anchor and σ may change at every call: nothing is compiled again.

    Args:
        heatmap: Cached candidates.
        anchor: Point in the object frame, [m].
        sigma: Distance from the anchor to the grasp axis at which a score falls to 1/e, [m].

    Raises:
        InputError: The anchor is not one point, or σ not one positive number.
    """
    anchor, sigma = _checked(heatmap, anchor, sigma)
    return weigh(heatmap.score_without_com, heatmap.thumb, heatmap.axis, anchor, sigma)


def steer_many(
    heatmap: Heatmap,
    anchors: Float[Array | np.ndarray, "a 3"],
    sigma: Float[Array | np.ndarray | np.floating, "*a"] | float = SIGMA_M,
) -> Float[Array, "a v"]:
    """Scores for many anchors at once, as :func:`steer` gives them one by one.

    Args:
        heatmap: Cached candidates.
        anchors: Points in the object frame, [m].
        sigma: Of all anchors, or of each, [m].

    Raises:
        InputError: The anchors are not points, or σ not positive, one or of each.
    """
    dtype = heatmap.score_without_com.dtype
    anchors, sigma = jnp.asarray(anchors, dtype), jnp.asarray(sigma, dtype)
    if anchors.ndim != 2 or anchors.shape[1] != 3:
        raise InputError("anchors", f"shape {anchors.shape}", "points [a, 3] in m")
    if sigma.shape not in ((), anchors.shape[:1]):
        raise InputError("sigma", f"shape {sigma.shape}", "one number, or one of each anchor, in m")
    _check_values("anchors", anchors)
    _check_positive(sigma)
    sigma = jnp.broadcast_to(sigma, anchors.shape[:1])
    return _weigh_many(heatmap.score_without_com, heatmap.thumb, heatmap.axis, anchors, sigma)


_weigh_many = jax.jit(jax.vmap(weigh, in_axes=(None, None, None, 0, 0)))


def steer_near(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    sigma: Sigma = SIGMA_M,
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

    Raises:
        InputError: The anchor is not one point, or σ not one positive number.
    """
    return _near(heatmap, *_checked(heatmap, anchor, sigma))


@jax.jit
def _near(
    heatmap: Heatmap, anchor: Float[Array, " 3"], sigma: Float[Array, ""]
) -> Float[Array, " v"]:
    along = dot(anchor - heatmap.thumb, heatmap.axis)
    beyond = jnp.maximum(jnp.maximum(-along, along - heatmap.width), 0.0)
    line = weigh(heatmap.score_without_com, heatmap.thumb, heatmap.axis, anchor, sigma)
    return line * jnp.exp(-((beyond / sigma) ** 2))


def steer_contacts(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    size: Float[Array | np.ndarray, " 3"] | None = None,
    sigma: Sigma | None = None,
) -> Float[Array, " v"]:
    """Scores for an anchor that all three contacts should be near; an addition to the method.

    ``S^c = S_without_COM · exp(−(D − D*)/σ²)`` with ``D = |d_t|² + |d_1|² + |d_2|²``, d the
    distances of thumb and wrap contacts from the box of a part, 0 inside: on the part its physical
    quality alone decides. D* is that of the candidate with the highest product: the best one keeps
    its own quality, so that scores are not all next to 0 where nothing is near, as they are around
    thin or far parts; those that are nearer, but worse, may score more than their own. The
    factor is never less than ``1e-9/(1 − ln of the product's ratio)``, so that of two distant
    candidates the nearer one is still preferred.

    Args:
        heatmap: Cached candidates.
        anchor: Point, or middle of the part's box, object frame [m].
        size: Edges of the box along the object's axes [m]; a point if None.
        sigma: Distance of one contact at which a score falls to 1/e [m]; :func:`contact_sigma` of
            the size if None.

    Raises:
        InputError: The anchor is not one point, the size not three edges, or σ not one positive
            number.
    """
    point, edges = (jnp.asarray(x) for x in (anchor, jnp.zeros(3) if size is None else size))
    for name, value in (("anchor", point), ("size", edges)):
        if value.shape != (3,):
            raise InputError(name, f"shape {value.shape}", "three numbers in m")
        _check_values(name, value)
    dtype = heatmap.score_without_com.dtype
    sigma = contact_sigma(edges) if sigma is None else _one_sigma(jnp.asarray(sigma, dtype))
    return _by_contacts(heatmap, point, 0.5 * edges, sigma)


@jax.jit
def _by_contacts(
    heatmap: Heatmap,
    anchor: Float[Array, " 3"],
    half: Float[Array, " 3"],
    sigma: Float[Array, ""] | float,
) -> Float[Array, " v"]:
    """`steer_contacts` with half of the size."""
    contacts = jnp.concatenate([heatmap.thumb[:, None], heatmap.wrap], axis=1)
    outside = norm(jnp.maximum(jnp.abs(contacts - anchor) - half, 0.0))
    apart = ((outside / sigma) ** 2).sum(axis=1)
    score = jnp.asarray(heatmap.score_without_com)
    counts = heatmap.valid & (score > 0.0)
    product = jnp.where(counts, jnp.log(jnp.where(counts, score, 1.0)) - apart, -jnp.inf)
    best = jnp.argmax(product)
    # Of the logarithms: the factors themselves underflow a few centimetres away.
    relative = jnp.where(counts, product - product[best], -jnp.inf)
    return score[best] * jnp.maximum(jnp.exp(relative), _TAIL / (1.0 - relative))


def contact_sigma(size: Float[Array | np.ndarray, " 3"]) -> Float[Array, ""]:
    """σ of :func:`steer_contacts` for a part [m]: an eighth of its shortest edge, at least 2 mm.

    Of a point it is `SIGMA_M`.
    """
    size = jnp.asarray(size)
    own = jnp.maximum(_PART_SHARE * size.min(), _LEAST_SIGMA_M)
    return jnp.where(size.max() > 0.0, own, SIGMA_M)


def steer_to(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    size: Float[Array | np.ndarray, " 3"] | None = None,
    sigma: Sigma | None = None,
    steering: Steering = "contacts",
) -> Float[Array, " v"]:
    """Scores for an anchor, in one of the ways of `Steering`.

    Args:
        heatmap: Cached candidates.
        anchor: Point, or middle of a part, in the object frame [m].
        size: Of the part [m]; only contacts are judged by it.
        sigma: Distance at which a score falls to 1/e [m]; by default of a point `SIGMA_M`, and of
            a part that contacts are to be on, its :func:`contact_sigma`.
        steering: What has to be near the anchor.

    Raises:
        InputError: The anchor is not one point, the size not three edges, or σ not one positive
            number.
    """
    if steering == "contacts":
        return steer_contacts(heatmap, anchor, size, sigma)
    way = steer if steering == "axis" else steer_near
    return way(heatmap, anchor, SIGMA_M if sigma is None else sigma)


def _checked(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    sigma: Sigma,
) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """Anchor and σ as the scores are kept, which may be traced.

    Raises:
        InputError: The anchor is not one point, or σ not one positive number.
    """
    dtype = heatmap.score_without_com.dtype
    point, scale = jnp.asarray(anchor, dtype), jnp.asarray(sigma, dtype)
    if point.shape != (3,):
        raise InputError("anchor", f"shape {point.shape}", "one point [3] in m")
    _check_values("anchor", point)
    return point, _one_sigma(scale)


def _one_sigma(sigma: Float[Array, ""]) -> Float[Array, ""]:
    if sigma.shape != ():
        raise InputError("sigma", f"shape {sigma.shape}", "one number in m")
    _check_positive(sigma)
    return sigma


def _check_values(name: str, values: Float[Array, "..."]) -> None:
    """Refuses what is not finite, where values are known: under jit and vmap they are not."""
    if not isinstance(values, jax.core.Tracer) and not np.isfinite(values).all():
        raise InputError(name, np.asarray(values).tolist(), "finite numbers in m")


def _check_positive(sigma: Float[Array, "..."]) -> None:
    """Refuses a σ of 0 or less, where it is known."""
    if not isinstance(sigma, jax.core.Tracer) and not (np.asarray(sigma) > 0.0).all():
        raise InputError("sigma", np.asarray(sigma).tolist(), "more than 0 m")
