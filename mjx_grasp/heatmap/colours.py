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
