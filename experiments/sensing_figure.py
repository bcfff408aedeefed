"""The picture of sensed forces: one grasp over time, and all forces against the solver's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mjx_grasp.viz.plots import GREY, new_figure, png, style

_TRUE, _FELT, _FLAG = "#9aa3ae", "#c8641e", "#2563a8"


def draw_grasp(
    true: Float[np.ndarray, "t w f"],
    felt: Float[np.ndarray, "t w f"],
    flag: Bool[np.ndarray, "t w f"],
    which: int,
    fingers: Sequence[str],
    dt: float,
) -> bytes:
    """One row per finger: its force in one trial, and the density of all trials' ticks, as PNG.

    Args:
        true: Norm of each finger's force by the solver [N].
        felt: By the estimator [N].
        flag: Contact flags.
        which: The trial to show over time.
        fingers: Names of the fingers.
        dt: Control period [s].
    """
    figure = new_figure(9.6, 2.1 * len(fingers) + 0.4)
    axes = figure.subplots(len(fingers), 2, width_ratios=(3, 1), squeeze=False)
    seconds = dt * (1 + np.arange(len(true)))
    for f, name in enumerate(fingers):
        series, dots = axes[f]
        top = 1.15 * max(np.percentile(true[:, which], 99.5), np.percentile(felt[:, which], 99.5))
        style(series)
        series.plot(seconds, true[:, which, f], color=_TRUE, linewidth=2.6, label="solver")
        series.plot(seconds, felt[:, which, f], color=_FELT, linewidth=1.1, label="felt")
        low = -0.06 * top
        series.fill_between(
            seconds, low, 0, where=flag[:, which, f], color=_FLAG, linewidth=0, label="contact flag"
        )
        series.set_ylim(low, top)
        series.set_xlim(0, seconds[-1])
        series.set_title(f"{name}, force [N]", loc="left", fontsize=10, color=GREY)
        style(dots)
        touching = true[..., f] > 0
        most = float(np.percentile(true[..., f][touching], 99)) if touching.any() else 1.0
        dots.hexbin(
            true[..., f][touching],
            felt[..., f][touching],
            gridsize=36,
            extent=(0, most, 0, most),
            bins="log",
            cmap="Blues",
            mincnt=1,
            linewidths=0,
        )
        dots.plot([0, most], [0, most], color=_FELT, linewidth=1)
        dots.set_xlim(0, most)
        dots.set_ylim(0, most)
        dots.set_title("felt against solver [N]", loc="left", fontsize=10, color=GREY)
    axes[0, 0].legend(
        frameon=False,
        fontsize=8,
        ncols=3,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        labelcolor=GREY,
    )
    axes[-1, 0].set_xlabel("time [s]", fontsize=9, color=GREY)
    axes[-1, 1].set_xlabel("solver [N]", fontsize=9, color=GREY)
    return png(figure)
