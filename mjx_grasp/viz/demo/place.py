"""Where an object is to be grasped: a place that is asked for, and scores steered to it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.steering import Heatmap, steer_to
from mjx_grasp.heatmap.summary import LEAST
from mjx_grasp.language.grounding import Anchor, target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.model import Shape
from mjx_grasp.pipeline.known import check_graspable
from mjx_grasp.robot.description import HandSpec
from mjx_grasp.viz.demo.config import DemoConfig

_BRIGHTEST = 0.99
_FARTHEST = 0.5  # an anchor from the object's box, of the object's largest extent


class Steered(NamedTuple):
    """Where the object is to be grasped."""

    heatmap: Heatmap
    score: Float[np.ndarray, " v"]
    """steered, the best is 1"""
    anchor: Float[np.ndarray, " 3"] | None
    """object frame [m]"""
    source: str
    """of the anchor, in words"""

    @property
    def shade(self) -> Float[np.ndarray, " v"]:
        """Scores as they are coloured: the best hundredth has the brightest, void is NaN."""
        valid = np.asarray(self.heatmap.valid)
        top = max(float(np.quantile(self.score[valid], _BRIGHTEST)), 1e-6)
        return np.where(valid, np.minimum(self.score / top, 1.0), np.nan)

    @property
    def best(self) -> Float[np.ndarray, "3 3"]:
        """The contacts with the best score, whether or not the hand gets there [m]."""
        k = int(np.argmax(np.where(self.heatmap.valid, self.score, -np.inf)))
        return np.vstack([self.heatmap.thumb[k], self.heatmap.wrap[k]])


def place_of(obj: Shape, config: DemoConfig) -> Anchor | None:
    """The place that is asked for, by a point or in words; None where there is none.

    Args:
        obj: The object, of which no more is needed.
        config: Of the demo.

    Raises:
        InputError: The point is far from the object.
        GroundingError: The words name no place on it.
    """
    if config.anchor is not None:
        point, (low, high) = np.asarray(config.anchor, np.float64), obj.mesh.bounds
        margin = _FARTHEST * float(obj.mesh.extents.max())
        if (point < low - margin).any() or (point > high + margin).any():
            lies = " to ".join(str(np.round(corner, 3).tolist()) for corner in (low, high))
            near = f"a point [m] near {obj.name}, which lies within {lies}"
            raise InputError("--anchor", config.anchor, near)
        return Anchor(point, "by a point")
    if config.instruction is None:
        return None
    target = target_of(obj.name, obj.mesh, obj.parts)
    found = PartGrounder().ground(config.instruction, target)
    return replace(found, source=f"“{config.instruction}” ({found.source})")


def steered_to(
    heatmap: Heatmap, place: Anchor | None, config: DemoConfig, hand: HandSpec
) -> Steered:
    """The heatmap with its scores steered to a place, or as they are without one.

    Args:
        heatmap: Of the object.
        place: From `place_of`.
        config: Of the demo.
        hand: That is to grasp the object.

    Raises:
        InputError: It can be grasped nowhere, or nowhere near the place.
    """
    score, anchor, source = heatmap.score, None, "anywhere good"
    check_graspable(config.object, float(jnp.max(heatmap.score_without_com)), hand, LEAST)
    if place is not None:
        anchor, source = place.point, place.source
        score = steer_to(heatmap, anchor, place.size, config.sigma, config.steering)
        if not score.any():  # all too far away for its numbers
            asked = config.instruction if config.anchor is None else config.anchor
            field = "--instruction" if config.anchor is None else "--anchor"
            raise InputError(field, asked, "a place nearer to a grasp, or a larger --sigma")
    best = float(jnp.max(score))
    check_graspable(config.object, best, hand)
    # Far from the middle of the object all scores are low: what counts is which is the best.
    return Steered(heatmap, np.asarray(score / best, np.float64), anchor, source)
