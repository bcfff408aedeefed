"""Success over something, as the pictures of several scripts draw it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes

COLOURS = ("#2563a8", "#c8641e", "#9aa3ae", "#4f7f54", "#7a4f9a")
"""Of controllers, in their order."""


def success_curve(ax: Axes, cells: Mapping[float, dict[str, Any]], colour: str, name: str) -> None:
    """Success with its interval.

    Args:
        ax: Where to.
        cells: Of `paper_tables.summed`, by what is along the axis.
        colour: Of the curve.
        name: For the legend.
    """
    low, high = ([cell[end] for cell in cells.values()] for end in ("low", "high"))
    ax.fill_between(list(cells), low, high, color=colour, alpha=0.15, linewidth=0)
    success = [cell["success"] for cell in cells.values()]
    ax.plot(list(cells), success, color=colour, marker="o", ms=3.5, label=name)
