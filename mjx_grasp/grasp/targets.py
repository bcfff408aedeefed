"""The three targets of a candidate: the ways to assign the tips, and which are high enough (§2).

Selection, planning and the making of handoffs all enumerate here. Candidates and ways to use them
are in the object frame; only the table's height needs its pose.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.vectors import dot, norm, unit
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import TargetConfig

NONE = -1
"""Index of no candidate."""
WAYS = 6
"""Of each candidate: reach axis x, x, y, y, z, z with both orders of the wraps."""


class Targets(NamedTuple):
    """The three-point interface; world frame."""

    valid: Bool[Array, ""]
    """whether there is an admissible candidate; where not, the rest is void but finite"""
    candidate: Int[Array, ""]
    """which, :data:`NONE` if there is none"""
    position: Float[Array, "3 3"]
    """contacts of thumb, first and second wrap [m]"""
    normal: Float[Array, "3 3"]
    """outward unit normals there"""
    cost: Float[Array, ""]
    """of the choice, +inf if there is none [m]"""


class TargetOptions(NamedTuple):
    """Ways to assign three tips to candidates; object frame."""

    candidate: Int[Array | np.ndarray, " v"]
    """which candidate"""
    axis: Int[Array | np.ndarray, " v"]
    """which object axis is the reach direction u"""
    spread: Float[Array, "v 3"]
    """unit direction ±unit(u × g) from the second wrap's target to the first's"""
    position: Float[Array, "v 3 3"]
    """targets of thumb, first and second wrap: p_t and c ± spread [m]"""
    normal: Float[Array, "v 3 3"]
    """outward unit normals: n_t, and unit(n_1 + n_2) for both wraps"""
    usable: Bool[Array, " v"]
    """whether there is a candidate and its reach axis spreads the wraps"""


def target_options(candidates: Candidates, config: TargetConfig) -> TargetOptions:
    """All ways: every candidate with every object axis and both orders of the wraps.

    Axes are lines: u and −u spread the wraps along the same line, in the other order. The ways of
    candidate k are :data:`WAYS` rows from ``WAYS · k``.
    """
    count = candidates.score.shape[0]
    candidate = np.repeat(np.arange(count), WAYS)
    axis = np.tile(np.repeat(np.arange(3), 2), count)
    sign = np.tile(np.array([1.0, -1.0], np.float32), 3 * count)
    return _options(candidates, candidate, axis, jnp.asarray(sign), config)


def latched_options(
    candidates: Candidates, reach: Float[Array, " 3"], config: TargetConfig
) -> TargetOptions:
    """One way of each candidate, in its order: of the axes that spread its wraps the preferred.

    Args:
        candidates: Of the object.
        reach: Preference of the object axes x, y, z as the reach direction.
        config: The least angle and the spread.
    """
    count = candidates.score.shape[0]
    length = norm(jnp.cross(jnp.eye(3), candidates.axis[:, None]))
    axis = closest_axis(reach, length >= config.min_axis_angle)
    return _options(candidates, np.arange(count), axis, jnp.ones(count), config)


def closest_axis(
    reach: Float[Array | np.ndarray, "*#n 3"], usable: Bool[Array | np.ndarray, "*#n 3"]
) -> Int[Array, "*n"]:
    """Of the usable object axes, the one of largest preference."""
    return jnp.argmax(jnp.where(usable, reach, -1.0), axis=-1)


def three_points(
    thumb: Float[Array, "*n 3"],
    centre: Float[Array, "*n 3"],
    spread: Float[Array, "*n 3"],
    config: TargetConfig,
) -> Float[Array, "*n 3 3"]:
    """Targets of thumb, first and second wrap: ``p_t`` and ``c ± spread``, [m]."""
    offset = config.wrap_spread * spread
    return jnp.stack([thumb, centre + offset, centre - offset], axis=-2)


def three_normals(
    normal: Float[Array, "*n 3"], wrap_normal: Float[Array, "*n 3"]
) -> Float[Array, "*n 3 3"]:
    """The normals at :func:`three_points`."""
    return jnp.stack([normal, wrap_normal, wrap_normal], axis=-2)


def standoffs(
    position: Float[Array | np.ndarray, "*n 3 3"],
    normal: Float[Array | np.ndarray, "*#n 3 3"],
    config: TargetConfig,
) -> Float[Array, "*n 3 3"]:
    """Where the tip frames are to be: outside the targets along their normals, [m]."""
    distance = [config.thumb_standoff, config.wrap_standoff, config.wrap_standoff]
    return jnp.asarray(position) + jnp.asarray(distance, jnp.float32)[:, None] * normal


def heights(
    candidates: Candidates,
    options: TargetOptions,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    config: TargetConfig,
) -> tuple[Float[Array, " v"], Float[Array, " v"]]:
    """How high each way is above the table: its lowest contact or target, its lowest goal, [m]."""
    up, height = R_wo[2], p_wo[2]
    wraps = dot(candidates.wrap, up)
    contacts = jnp.minimum(wraps[:, 0], wraps[:, 1])[options.candidate]
    targets = dot(options.position, up)
    goals = dot(standoffs(options.position, options.normal, config), up)
    return jnp.minimum(_least(targets), contacts) + height, _least(goals) + height


def admissible(
    candidates: Candidates,
    options: TargetOptions,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    config: TargetConfig,
) -> Bool[Array, " v"]:
    """Which ways are usable and high enough with the object at a place.

    Args:
        candidates: Of the object.
        options: Ways to use them.
        p_wo: Object origin in world, [m].
        R_wo: Object rotation.
        config: The least heights, and the standoffs that lead to the goals.
    """
    lowest, goal = heights(candidates, options, p_wo, R_wo, config)
    return options.usable & (lowest >= config.min_height) & (goal >= config.min_goal_height)


def _options(
    candidates: Candidates,
    candidate: Int[np.ndarray, " v"],
    axis: Int[Array | np.ndarray, " v"],
    sign: Float[Array, " v"],
    config: TargetConfig,
) -> TargetOptions:
    across = jnp.cross(jnp.eye(3)[axis], candidates.axis[candidate])
    spread = sign[:, None] * unit(across)
    return TargetOptions(
        candidate=candidate,
        axis=axis,
        spread=spread,
        position=three_points(
            candidates.thumb[candidate], candidates.centre[candidate], spread, config
        ),
        normal=three_normals(candidates.normal[candidate], candidates.wrap_normal[candidate]),
        usable=candidates.valid[candidate] & (norm(across) >= config.min_axis_angle),
    )


def _least(values: Float[Array, "v 3"]) -> Float[Array, " v"]:
    return jnp.minimum(jnp.minimum(values[:, 0], values[:, 1]), values[:, 2])
