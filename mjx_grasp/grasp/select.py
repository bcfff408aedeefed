"""Which candidate the hand goes for, tick by tick, and its three targets (method §2).

Everything is worked out in the object frame, into which only the hand has to be brought. One state
at a time; thousands of them are a ``vmap``.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry.vectors import angle_between, dot, norm, turned, turned_back
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.targets import NONE, Targets, admissible, latched_options, three_points


class HandPose(NamedTuple):
    """The hand at one tick; world frame."""

    tips: Float[Array, "3 3"]
    """tip frames of thumb, first and second wrap [m]"""
    approach: Float[Array, " 3"]
    """unit approach direction of the palm"""
    opposing: Float[Array, " 3"]
    """unit opposing axis of the palm"""


class SelectionState(NamedTuple):
    """What the selection remembers between ticks; object frame."""

    candidate: Int[Array, ""]
    """the running one, :data:`~mjx_grasp.grasp.targets.NONE` before the first"""
    spread: Float[Array, " 3"]
    """unit direction from the second wrap's target to the first's, zero before the first choice"""
    reach: Float[Array, " 3"]
    """preference of the object axes x, y, z as the reach direction u; latched"""
    bias: Float[Array, " c"]
    """added to every candidate's cost, +inf rules one out [m]"""


def start_selection(
    candidates: Candidates, hand: HandPose, R_wo: Float[Array, "3 3"]
) -> SelectionState:
    """The state at the start of a trial: it latches the reach direction.

    Of the six object axes the one closest to the palm's approach direction; an axis and its
    opposite spread the wraps along the same line, so three preferences say it all.
    """
    return SelectionState(
        candidate=jnp.int32(NONE),
        spread=jnp.zeros(3),
        reach=jnp.abs(turned_back(R_wo, hand.approach)),
        bias=jnp.zeros(candidates.score.shape[0]),
    )


def select(
    candidates: Candidates,
    state: SelectionState,
    hand: HandPose,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    config: SelectionConfig,
) -> tuple[Targets, SelectionState]:
    """The candidate of least cost and its targets.

    ``cost = |x_T − p_t| + |x_W − c| + w_a ∠(palm, g) − w_s S + w_w |w − span| + bias``; the running
    candidate is left only for an improvement above the hysteresis.

    Args:
        candidates: Of the object.
        state: From :func:`start_selection` or the last tick.
        hand: Its present pose.
        p_wo: Object origin in world, [m].
        R_wo: Object rotation.
        config: Weights and thresholds.
    """
    tips = turned_back(R_wo, hand.tips - p_wo)
    opposing = turned_back(R_wo, hand.opposing)
    options = latched_options(candidates, state.reach, config.targets)
    allowed = admissible(candidates, options, p_wo, R_wo, config.targets)
    allowed &= candidates.score >= config.min_score
    cost = _cost(candidates, tips, opposing, config) + state.bias
    cost = jnp.where(allowed, cost, jnp.inf)

    best = jnp.argmin(cost).astype(jnp.int32)
    running = jnp.maximum(state.candidate, 0)
    keeps = (state.candidate != NONE) & (cost[running] - cost[best] <= config.hysteresis)
    keeps &= jnp.isfinite(cost[running])
    index = jnp.where(keeps, running, best)
    valid = jnp.isfinite(cost[index])

    spread = _ordered(options.spread[index], state.spread, tips[1] - tips[2], config.swap_angle)
    local = three_points(candidates.thumb[index], candidates.centre[index], spread, config.targets)
    targets = Targets(
        valid=valid,
        candidate=jnp.where(valid, index, NONE),
        position=p_wo + turned(R_wo, local),
        normal=turned(R_wo, options.normal[index]),
        cost=cost[index],
    )
    new_state = state._replace(
        candidate=targets.candidate, spread=jnp.where(valid, spread, state.spread)
    )
    return targets, new_state


def _cost(
    candidates: Candidates,
    tips: Float[Array, "3 3"],
    opposing: Float[Array, " 3"],
    config: SelectionConfig,
) -> Float[Array, " c"]:
    wraps = 0.5 * (tips[1] + tips[2])
    span = norm(tips[0] - wraps)
    angle = angle_between(candidates.axis, opposing)
    angle = jnp.minimum(angle, jnp.pi - angle)
    return (
        norm(tips[0] - candidates.thumb)
        + norm(wraps - candidates.centre)
        + config.angle_weight * angle
        - config.score_weight * candidates.score
        + config.span_weight * jnp.abs(candidates.width - span)
    )


def _ordered(
    along: Float[Array, " 3"],
    running: Float[Array, " 3"],
    towards_first: Float[Array, " 3"],
    swap_angle: float,
) -> Float[Array, " 3"]:
    """``along`` or its opposite, whichever suits the fingers' order, with hysteresis."""
    here = angle_between(along, towards_first)
    gain = 2.0 * here - jnp.pi  # of −along over along
    follows = dot(along, running)
    # Kept as it ran; the first choice has nothing to keep.
    threshold = jnp.where(follows > 0, swap_angle, jnp.where(follows < 0, -swap_angle, 0.0))
    return jnp.where(gain > threshold, -along, along)
