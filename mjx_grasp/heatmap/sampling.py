"""Drawing grasp triples from a heatmap: good ones more often, no two alike (method §1)."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.heatmap.steering import Heatmap


class Triples(NamedTuple):
    """Grasp triples in the order in which they were drawn, object frame.

    Where ``valid`` is False there was no admissible candidate left: the score is 0 and the rest is
    void, but finite.

    Attributes:
        candidate: ``[n]`` which one of the heatmap each is.
        thumb: ``[n, 3]`` thumb contacts [m].
        thumb_normal: ``[n, 3]`` outward unit normals there.
        wrap: ``[n, 2, 3]`` index and middle contacts [m].
        wrap_normals: ``[n, 2, 3]`` outward unit normals there.
        axis: ``[n, 3]`` unit grasp axes, from the thumb to the middle of the wrap contacts.
        width: ``[n]`` distances along them [m].
        score: ``[n]`` the scores that were drawn from.
        valid: ``[n]`` whether there is a triple.
    """

    candidate: Int[Array, " n"]
    thumb: Float[Array, "n 3"]
    thumb_normal: Float[Array, "n 3"]
    wrap: Float[Array, "n 2 3"]
    wrap_normals: Float[Array, "n 2 3"]
    axis: Float[Array, "n 3"]
    width: Float[Array, " n"]
    score: Float[Array, " n"]
    valid: Bool[Array, " n"]


def sample_triples(
    key: PRNGKeyArray | UInt32[Array, "2"],
    heatmap: Heatmap,
    count: int,
    score: Float[Array | np.ndarray, " v"] | None = None,
    *,
    temperature: float | Float[Array, ""] = 0.05,
    top_k: int | None = None,
    min_distance: float | Float[Array, ""] = 0.02,
    min_score: float | Float[Array, ""] = 0.05,
) -> Triples:
    """Draws triples one after the other, with probability ∝ exp(S/temperature).

    After each draw the candidates closer to it than ``min_distance`` are out (non-maximum
    suppression), so the triples are diverse; the next is drawn from those that are left, by the
    same law. Deterministic by key; jits with a static ``count`` and ``top_k``, and vmaps over keys,
    scores and temperatures.

    Args:
        key: Source of randomness; at temperature 0 it does not matter.
        heatmap: Candidates.
        count: How many triples.
        score: Scores to draw by, for example of :func:`~.steering.steer`; the heatmap's
            own if None.
        temperature: In units of the score; 0 takes the best candidate that is left every time.
        top_k: Draws from this many best candidates only; from all if None.
        min_distance: Two triples differ when their thumb contacts or their wrap centres are at
            least this far apart [m]; see :func:`triple_distance`.
        min_score: Candidates below are never drawn.

    Raises:
        InputError: ``count`` or ``top_k`` is below 1, or the temperature is a negative number.
    """
    if count < 1:
        raise InputError("count", count, "at least 1")
    if top_k is not None and top_k < 1:
        raise InputError("top_k", top_k, "at least 1, or None for all")
    if isinstance(temperature, int | float) and not temperature >= 0:
        raise InputError("temperature", temperature, "0 or more")
    score = heatmap.score if score is None else score
    heatmap = jax.tree.map(jnp.asarray, heatmap)
    return _draw(
        key, heatmap, jnp.asarray(score), temperature, min_distance, min_score, count, top_k
    )


def best_triple(heatmap: Heatmap, score: Float[Array | np.ndarray, " v"] | None = None) -> Triples:
    """The triple of the highest score, as :class:`Triples` of one row.

    It is not valid where every score is 0.
    """
    return sample_triples(
        jax.random.key(0), heatmap, 1, score, temperature=0.0, min_distance=0.0, min_score=0.0
    )


def triple_distance(
    thumb_1: Float[Array, "*#batch 3"],
    centre_1: Float[Array, "*#batch 3"],
    thumb_2: Float[Array, "*#batch 3"],
    centre_2: Float[Array, "*#batch 3"],
) -> Float[Array, "*batch"]:
    """How different two triples are: the larger distance of thumb contacts and wrap centres [m]."""
    return jnp.maximum(norm(thumb_1 - thumb_2), norm(centre_1 - centre_2))


@partial(jax.jit, static_argnames=("count", "top_k"))
def _draw(
    key: PRNGKeyArray | UInt32[Array, "2"],
    heatmap: Heatmap,
    score: Float[Array, " v"],
    temperature: Float[Array, ""] | float,
    min_distance: Float[Array, ""] | float,
    min_score: Float[Array, ""] | float,
    count: int,
    top_k: int | None,
) -> Triples:
    open_ = heatmap.valid & (score >= min_score) & (score > 0)
    if top_k is not None and top_k < len(score):
        best = jax.lax.top_k(jnp.where(open_, score, -1.0), top_k)[1]
        open_ &= jnp.zeros_like(open_).at[best].set(True)
    # The Gumbel trick, scaled by the temperature, so that 0 is no special case. What remains after
    # taking a maximum and what depends on it is again a draw by the same law.
    noisy = score + temperature * jax.random.gumbel(key, score.shape, score.dtype)

    def step(
        open_: Bool[Array, " v"], _: None
    ) -> tuple[Bool[Array, " v"], tuple[Int[Array, ""], Bool[Array, ""]]]:
        index = jnp.argmax(jnp.where(open_, noisy, -jnp.inf))
        found = open_[index]
        gap = triple_distance(
            heatmap.thumb, heatmap.centre, heatmap.thumb[index], heatmap.centre[index]
        )
        # The drawn one is out even at a distance of 0.
        open_ = open_ & (gap >= min_distance) & (jnp.arange(len(score)) != index)
        return open_, (index, found)

    _, (index, valid) = jax.lax.scan(step, open_, length=count)
    return Triples(
        candidate=index,
        thumb=heatmap.thumb[index],
        thumb_normal=heatmap.normals[index],
        wrap=heatmap.wrap[index],
        wrap_normals=heatmap.wrap_normals[index],
        axis=heatmap.axis[index],
        width=heatmap.width[index],
        score=jnp.where(valid, score[index], 0.0),
        valid=valid,
    )
