"""One colour scale for every picture of a heatmap: purple for 0, yellow for the top."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps

MAP = "viridis"
"""Perceptually even, and readable without colour vision."""
VOID = (150, 150, 158)
"""Where the surface has no candidate at all."""


def score_colours(score: Float[np.ndarray, "*n"], top: float = 1.0) -> UInt8[np.ndarray, "*n 3"]:
    """Colours of scores.

    Args:
        score: Scores in [0, 1]; not a number where there is no candidate, which becomes grey.
        top: The score that gets the yellow end; everything above it does too.
    """
    score = np.asarray(score, np.float64)
    void = np.isnan(score)
    share = np.clip(np.where(void, 0.0, score) / top, 0.0, 1.0)
    colours = np.round(255.0 * colormaps[MAP](share)[..., :3]).astype(np.uint8)
    colours[void] = VOID
    return colours


def steered_shade(
    score: Float[np.ndarray, " v"], brightest: float = 0.05
) -> Float[np.ndarray, " v"]:
    """Square roots of steered scores, on a scale of their own whose best share is at 1.

    Else one good point darkens the rest of a thin part. The share is of those candidates that have
    any score to speak of: a stem has few.

    Args:
        score: Of the candidates of one object.
        brightest: Share of them that gets the yellow end.
    """
    spoken = score[score > 0.01 * score.max()]
    if not len(spoken):
        return score
    return np.sqrt(np.minimum(score / np.quantile(spoken, 1.0 - brightest), 1.0))
