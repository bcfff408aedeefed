"""Grasp candidates as the selection sees them: from a heatmap, or of a cylinder in closed form."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import unit
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.scores import anchor_score, separation_score, width_score
from mjx_grasp.heatmap.steering import Heatmap

_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], np.float32) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
"""To the faces, edges and corners of a cube: 26, with a sign, as the thumb's side matters."""


class Candidates(NamedTuple):
    """Candidates of one object, in the object frame; objects are stacked in front."""

    thumb: Float[Array, "c 3"]
    """thumb contacts p_t [m]"""
    normal: Float[Array, "c 3"]
    """outward unit normals n_t there"""
    wrap: Float[Array, "c 2 3"]
    """wrap contacts c_1, c_2 [m]"""
    wrap_normal: Float[Array, "c 3"]
    """unit(n_1 + n_2)"""
    axis: Float[Array, "c 3"]
    """unit grasp axes g"""
    width: Float[Array, " c"]
    """w [m]"""
    score: Float[Array, " c"]
    """the steered score S; 0 where there is no candidate [-]"""
    valid: Bool[Array, " c"]
    """whether there is a candidate at all"""

    @property
    def centre(self) -> Float[Array, "c 3"]:
        """Centroids of the wrap contacts, [m]."""
        return 0.5 * (self.wrap[..., 0, :] + self.wrap[..., 1, :])


def check_scores(heatmap: Heatmap, score: Float[Array | np.ndarray, " v"]) -> None:
    """Refuses scores that are not those of a heatmap.

    Raises:
        InputError: They are not one of each candidate, or known and not finite or below 0.
    """
    if jnp.shape(score) != heatmap.score.shape:
        expected = f"one of each of the heatmap's {len(heatmap.score):,} candidates"
        raise InputError("score", f"shape {jnp.shape(score)}", expected)
    if isinstance(score, jax.core.Tracer):
        return
    if not (np.isfinite(score).all() and (np.asarray(score) >= 0).all()):
        raise InputError("score", "NaN, infinity or less than 0", "finite numbers, 0 or more")


def vertex_candidates(heatmap: Heatmap, score: Float[Array, " v"] | None = None) -> Candidates:
    """All candidates of a heatmap, in the order of its vertices.

    Args:
        heatmap: Of the object.
        score: Steered scores; the heatmap's own if None.

    Raises:
        InputError: The scores are not one of each candidate.
    """
    heatmap = jax.tree.map(jnp.asarray, heatmap)
    scores = heatmap.score if score is None else jnp.asarray(score)
    check_scores(heatmap, scores)
    return Candidates(
        thumb=heatmap.thumb,
        normal=heatmap.normals,
        wrap=heatmap.wrap,
        wrap_normal=unit(heatmap.wrap_normals[:, 0] + heatmap.wrap_normals[:, 1]),
        axis=heatmap.axis,
        width=heatmap.width,
        score=jnp.where(heatmap.valid, scores, 0.0),
        valid=heatmap.valid,
    )


def from_heatmap(
    heatmap: Heatmap, score: Float[Array, " v"] | None = None, count: int | None = None
) -> Candidates:
    """The candidates of a heatmap, all or the best ``count`` of them by score; jittable.

    Those that tie stay in the order of their vertices. With fewer than ``count`` vertices the rest
    is filled with invalid ones, so that objects can be stacked.

    Args:
        heatmap: Of the object.
        score: Steered scores; the heatmap's own if None.
        count: How many.

    Raises:
        InputError: A count below one, or scores that are not one of each candidate.
    """
    if count is not None and count < 1:
        raise InputError("count", count, "a whole number from 1")
    everything = vertex_candidates(heatmap, score)
    available = everything.score.shape[0]
    count = available if count is None else count
    _, order = jax.lax.top_k(everything.score, min(count, available))
    return _taken(everything, order, count)


def first_and_rest(
    heatmap: Heatmap,
    score: Float[Array, " v"] | None,
    first: int,
    count: int,
    rest_scored: bool = False,
) -> Candidates:
    """The best by a score, and some others that are to be had where those are not.

    The others are the best by the heatmap's own score in each direction of the grasp axis, so that
    there are some for an object that lies on its best faces, or on the anchor. Jittable.

    Args:
        heatmap: Of the object.
        score: Steered scores; the heatmap's own if None.
        first: How many are chosen by the score.
        count: How many in all; those that are wanting are invalid.
        rest_scored: Whether the others have the score, too; else they have none.
    """
    everything, wanted = vertex_candidates(heatmap), vertex_candidates(heatmap, score).score
    ranked, best = jax.lax.top_k(wanted, min(first, len(wanted)))
    left = everything.score.at[best].multiply(ranked <= 0)
    rest = evenly_over_directions(everything._replace(score=left))[: count - first]
    chosen = _taken(everything, jnp.concatenate([best, rest]), count)
    scores = jnp.concatenate([ranked, wanted[rest] if rest_scored else jnp.zeros(len(rest))])
    usable = jnp.concatenate([ranked > 0, left[rest] > 0])
    scores, usable = (
        jnp.pad(x, (0, count - len(x))) for x in (jnp.where(usable, scores, 0.0), usable)
    )
    return chosen._replace(score=scores, valid=usable)


def evenly_over_directions(candidates: Candidates) -> Int[Array, " c"]:
    """An order in which each direction of the grasp axis has its turn, with its best first.

    Args:
        candidates: In any order; those that are invalid or have no score come last.
    """
    scored = candidates.valid & (candidates.score > 0)
    direction = jnp.argmax(candidates.axis @ jnp.asarray(_DIRECTIONS).T, axis=1)
    direction = jnp.where(scored, direction, len(_DIRECTIONS))
    sorted_by_it = jnp.lexsort((-candidates.score, direction))
    ranked = direction[sorted_by_it]
    within = jnp.arange(len(ranked)) - jnp.searchsorted(ranked, ranked)
    turn = jnp.zeros_like(within).at[sorted_by_it].set(within)
    return jnp.lexsort((-candidates.score, turn, ~scored))


def _taken(candidates: Candidates, order: Int[Array, " n"], count: int) -> Candidates:
    """Some of them, filled up with invalid ones."""

    def taken(leaf: Array) -> Array:
        filler = [(0, max(count - len(order), 0))] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf[order], filler)

    return jax.tree.map(taken, candidates)


def cylinder_candidates(
    radius: Float[Array, ""],
    half_length: Float[Array, ""],
    span: tuple[float, float],
    around: int = 24,
    along: int = 15,
    config: HeatmapConfig | None = None,
) -> Candidates:
    """The heatmap of a cylinder about z in closed form, on a grid of its side.

    A ray from the side meets the opposite side, the long axis runs lengthwise, and all normals are
    along the grasp axis: only the terms of width, centre of mass and separation differ from 1.

    Args:
        radius: In [m].
        half_length: In [m].
        span: Narrowest and widest grasp of the hand, [m].
        around: Grid points around the axis.
        along: Grid points along it, between the ends less the widest wrap offset.
        config: Settings of the heatmap.
    """
    config = config or HeatmapConfig()
    # The smallest offset that separates the wraps fully: it ties with the larger ones.
    offset = min(
        (h for h in config.wrap_offsets if 2 * h >= config.full_separation),
        default=config.wrap_offsets[-1],
    )
    room = jnp.maximum(half_length - offset, 0.0)
    angle = jnp.arange(around) * (2 * jnp.pi / around)
    height = jnp.linspace(-1.0, 1.0, along)[:, None] * room
    out = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(around)], axis=-1)
    normal = jnp.broadcast_to(out, (along, around, 3)).reshape(-1, 3)
    z = jnp.broadcast_to(height, (along, around)).reshape(-1)
    up = jnp.asarray([0.0, 0.0, 1.0])
    thumb = radius * normal + z[:, None] * up
    opposing = -radius * normal + z[:, None] * up
    wrap = jnp.stack([opposing + offset * up, opposing - offset * up], axis=1)
    width = jnp.full(len(z), 2.0 * radius)
    score = (
        width_score(width, jnp.asarray(span), config.narrow_sigma, config.width_sigma)
        * anchor_score(jnp.zeros(3), thumb, -normal, config.com_sigma)
        * separation_score(wrap[:, 0], wrap[:, 1], config.full_separation)
    )
    return Candidates(thumb, normal, wrap, -normal, -normal, width, score, jnp.ones(len(z), bool))
