"""Steering to grasps that are where the anchor is, and not only in line with it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import dot
from mjx_grasp.heatmap.steering import Heatmap, steer


@jax.jit
def steer_near(
    heatmap: Heatmap,
    anchor: Float[Array | np.ndarray, " 3"],
    sigma: Float[Array, ""] | float = 0.030,
) -> Float[Array, " v"]:
    """Scores for an anchor that should lie between the contacts; an addition to the method.

    The publication's factor (:func:`~.steering.steer`) measures the anchor's distance d⊥
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
