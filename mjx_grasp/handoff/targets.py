"""Three target points from a heatmap candidate and a reach direction (method §2, 'Targets')."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mjx_grasp.grasp.config import TargetConfig

# The object axes as lines: u and −u spread the wraps along the same line, in the other order.
REACH_AXES = np.eye(3)


class TargetVariants(NamedTuple):
    """The ways to assign three tips to a candidate; object frame.

    Attributes:
        position: ``[n, 6, 3, 3]`` targets of thumb, first and second wrap in [m]; six variants,
            reach axis x, x, y, y, z, z with both orders of the wraps.
        normal: ``[n, 3, 3]`` outward unit normals: n_t, and unit(n_1 + n_2) for both wraps.
        usable: ``[n, 6]`` whether the reach axis spreads the wraps, |u × g| large enough.
    """

    position: Float[np.ndarray, "n 6 3 3"]
    normal: Float[np.ndarray, "n 3 3"]
    usable: Bool[np.ndarray, "n 6"]


def target_variants(
    thumb: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "n 3"],
    axis: Float[np.ndarray, "n 3"],
    wrap_normals: Float[np.ndarray, "n 2 3"],
    config: TargetConfig,
) -> TargetVariants:
    """``p_1 = p_t``, ``p_2,3 = c ± spread·unit(u × g)`` for every object axis u and both signs.

    Args:
        thumb: Thumb contacts p_t in [m].
        normal: Outward unit normals there.
        centre: Centroids c of the wrap contacts in [m].
        axis: Unit grasp axes g.
        wrap_normals: Outward unit normals at the wrap contacts.
        config: Spread and the least |u × g|.
    """
    across = np.cross(REACH_AXES[None], axis[:, None])
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    along = across / np.maximum(length, 1e-9)
    signed = np.stack([along, -along], axis=2).reshape(len(thumb), 6, 3)
    offset = config.wrap_spread * signed
    position = np.stack(
        [
            np.broadcast_to(thumb[:, None], offset.shape),
            centre[:, None] + offset,
            centre[:, None] - offset,
        ],
        axis=2,
    )
    wrap = wrap_normals.sum(axis=1)
    wrap = wrap / np.maximum(np.linalg.norm(wrap, axis=-1, keepdims=True), 1e-9)
    usable = np.repeat(length[..., 0] >= config.min_axis_angle, 2, axis=1)
    return TargetVariants(position, np.stack([normal, wrap, wrap], axis=1), usable)


def standoffs(
    position: Float[np.ndarray, "*n 3 3"],
    normal: Float[np.ndarray, "*n 3 3"],
    config: TargetConfig,
) -> Float[np.ndarray, "*n 3 3"]:
    """Where the tip frames' origins are to be: outside the targets along their normals, [m]."""
    distance = np.array([config.thumb_standoff, config.wrap_standoff, config.wrap_standoff])
    return position + distance[:, None] * normal


def closest_reach_axis(
    approach: Float[np.ndarray, "n 3"], usable: Bool[np.ndarray, "n 6"]
) -> np.ndarray:
    """Of the usable object axes, the index of the one closest to the palm's approach direction.

    Args:
        approach: Unit approach directions of the palm in the object frame.
        usable: Of the six variants, as in :class:`TargetVariants`.
    """
    return np.argmax(np.where(usable[:, ::2], np.abs(approach), -1.0), axis=1)
