"""Which candidate the hand goes for, tick by tick, and its three targets (method §2).

Everything is worked out in the object frame, into which only the hand has to be brought. One state
at a time; thousands of them are a ``vmap``.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.vectors import angle_between, dot, norm, unit
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig

NONE = -1
"""Index of no candidate."""


class Hand(NamedTuple):
    """The hand at one tick; world frame.

    Attributes:
        tips: ``[3, 3]`` tip frames of thumb, first and second wrap, [m].
        approach: ``[3]`` unit approach direction of the palm.
        opposing: ``[3]`` unit opposing axis of the palm.
    """

    tips: Float[Array, "3 3"]
    approach: Float[Array, " 3"]
    opposing: Float[Array, " 3"]


class SelectionState(NamedTuple):
    """What the selection remembers between ticks; object frame.

    Attributes:
        candidate: The running one, :data:`NONE` before the first.
        spread: ``[3]`` unit direction from the second wrap's target to the first's; zero before
            the first choice.
        reach: ``[3]`` preference of the object axes x, y, z as the reach direction u; latched.
        bias: ``[c]`` added to every candidate's cost, [m]; +inf rules one out.
    """

    candidate: Int[Array, ""]
    spread: Float[Array, " 3"]
    reach: Float[Array, " 3"]
    bias: Float[Array, " c"]


class Targets(NamedTuple):
    """The three-point interface; world frame.

    Attributes:
        valid: Whether there is an admissible candidate; where not, the rest is void but finite.
        candidate: Which, :data:`NONE` if there is none.
        position: ``[3, 3]`` contacts of thumb, first and second wrap, [m].
        normal: ``[3, 3]`` outward unit normals there.
        cost: Of the choice, [m]; +inf if there is none.
    """

    valid: Bool[Array, ""]
    candidate: Int[Array, ""]
    position: Float[Array, "3 3"]
    normal: Float[Array, "3 3"]
    cost: Float[Array, ""]


def start_selection(
    candidates: Candidates, hand: Hand, R_wo: Float[Array, "3 3"]
) -> SelectionState:
    """The state at the start of a trial: it latches the reach direction.

    Of the six object axes the one closest to the palm's approach direction; an axis and its
    opposite spread the wraps along the same line, so three preferences say it all.
    """
    return SelectionState(
        candidate=jnp.int32(NONE),
        spread=jnp.zeros(3),
        reach=jnp.abs(_turned_back(R_wo, hand.approach)),
        bias=jnp.zeros(candidates.score.shape[0]),
    )


def select(
    candidates: Candidates,
    state: SelectionState,
    hand: Hand,
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
    tips = _turned_back(R_wo, hand.tips - p_wo)
    opposing = _turned_back(R_wo, hand.opposing)
    up, floor = R_wo[2], config.min_height - p_wo[2]

    along = spread_directions(candidates, state.reach, config)
    offset = config.wrap_spread * along
    cost = _cost(candidates, tips, opposing, config) + state.bias
    lowest = jnp.minimum(
        dot(candidates.thumb, up),
        jnp.minimum(dot(candidates.wrap[:, 0], up), dot(candidates.wrap[:, 1], up)),
    )
    lowest = jnp.minimum(lowest, dot(candidates.centre, up) - jnp.abs(dot(offset, up)))
    thumb_goal, wrap_goal = _goal_heights(candidates, offset, up, config.standoffs)
    lowest_goal = p_wo[2] + jnp.minimum(thumb_goal, wrap_goal)
    admissible = candidates.valid & (candidates.score >= config.min_score)
    admissible &= (lowest >= floor) & (lowest_goal >= config.min_goal_height)
    cost = jnp.where(admissible, cost, jnp.inf)

    best = jnp.argmin(cost).astype(jnp.int32)
    running = jnp.maximum(state.candidate, 0)
    keeps = (state.candidate != NONE) & (cost[running] - cost[best] <= config.hysteresis)
    keeps &= jnp.isfinite(cost[running])
    index = jnp.where(keeps, running, best)
    valid = jnp.isfinite(cost[index])

    spread = _ordered(along[index], state.spread, tips[1] - tips[2], config.swap_angle)
    centre = candidates.centre[index]
    local = jnp.stack(
        [
            candidates.thumb[index],
            centre + config.wrap_spread * spread,
            centre - config.wrap_spread * spread,
        ]
    )
    wrap_normal = candidates.wrap_normal[index]
    normal = jnp.stack([candidates.normal[index], wrap_normal, wrap_normal])
    targets = Targets(
        valid=valid,
        candidate=jnp.where(valid, index, NONE),
        position=p_wo + _turned(R_wo, local),
        normal=_turned(R_wo, normal),
        cost=cost[index],
    )
    new_state = state._replace(
        candidate=targets.candidate, spread=jnp.where(valid, spread, state.spread)
    )
    return targets, new_state


def _goal_heights(candidates, offset, up, standoffs):
    """How high the standoff targets of thumb and lower wrap are above the object's origin, [m]."""
    thumb = dot(candidates.thumb + standoffs[0] * candidates.normal, up)
    wrap = dot(candidates.centre + standoffs[1] * candidates.wrap_normal, up)
    return thumb, wrap - jnp.abs(dot(offset, up))


def _cost(candidates, tips, opposing, config):
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


def spread_directions(
    candidates: Candidates, reach: Float[Array, " 3"], config: SelectionConfig
) -> Float[Array, "c 3"]:
    """unit(u × g) of each candidate, for the preferred axis u that spreads its wraps at all."""
    axes = jnp.eye(3, dtype=reach.dtype)
    across = jnp.cross(axes[:, None], candidates.axis[None])
    length = norm(across)
    usable = length >= config.min_axis_angle
    chosen = jnp.argmax(jnp.where(usable, reach[:, None], -1.0), axis=0)
    picked = jnp.take_along_axis(across, chosen[None, :, None], axis=0)[0]
    return unit(picked)


def _ordered(along, running, towards_first, swap_angle):
    """``along`` or its opposite, whichever suits the fingers' order, with hysteresis."""
    here = angle_between(along, towards_first)
    gain = 2.0 * here - jnp.pi  # of −along over along
    follows = dot(along, running)
    # Kept as it ran; the first choice has nothing to keep.
    threshold = jnp.where(follows > 0, swap_angle, jnp.where(follows < 0, -swap_angle, 0.0))
    return jnp.where(gain > threshold, -along, along)


def _turned(R, vec):
    return vec[..., :1] * R[:, 0] + vec[..., 1:2] * R[:, 1] + vec[..., 2:] * R[:, 2]


def _turned_back(R, vec):
    return vec[..., :1] * R[0] + vec[..., 1:2] * R[1] + vec[..., 2:] * R[2]
