"""Words beside the points of a plot, where they cover nothing."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.path import Path
from matplotlib.transforms import Bbox

_GAPS = (7.0, 14.0)  # points between the middle of a point's marker and its words
_SIDES = (  # of the point, and what of the words is next to it
    ((-0.8, 0.8), "right", "bottom"),
    ((0.8, -0.8), "left", "top"),
    ((0.8, 0.8), "left", "bottom"),
    ((-0.8, -0.8), "right", "top"),
    ((0.0, 1.0), "center", "bottom"),
    ((0.0, -1.0), "center", "top"),
    ((1.0, 0.0), "left", "center"),
    ((-1.0, 0.0), "right", "center"),
)


class Label(NamedTuple):
    """Words beside a point."""

    text: str
    x: float
    y: float
    colour: str


def place(ax: Axes, labels: Sequence[Label], size: float = 8) -> list[Bbox]:
    """Writes labels where they cover no other label, no marker and as few lines as possible.

    A label for which there is no such place is left out. Call it when the figure is otherwise
    finished: what is moved later, by a layout or by other limits, is no longer where it was looked
    at.

    Args:
        ax: With points and lines. Every labelled point counts as having a marker.
        labels: What to write, the most important first.
        size: Of the words [points].

    Returns:
        Where words are, in pixels.
    """
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    lines, markers = _drawn(ax)
    taken: list[Bbox] = []
    for label in labels:
        free = []
        for gap, ((right, up), ha, va) in itertools.product(_GAPS, _SIDES):
            offset = gap * right, gap * up
            words = ax.annotate(
                label.text, (label.x, label.y), xytext=offset, textcoords="offset points",
                color=label.colour, fontsize=size, ha=ha, va=va,
            )  # fmt: skip
            box = words.get_window_extent()
            words.remove()
            if not (box.count_overlaps(taken + markers) or _outside(box, ax.bbox)):
                crossed = sum(line.intersects_bbox(box, filled=False) for line in lines)
                free.append((crossed, box, words))
        if free:
            _, box, words = min(free, key=lambda found: found[0])  # the first of them
            ax.add_artist(words)
            taken.append(box)
    return taken


def _drawn(ax: Axes) -> tuple[list[Path], list[Bbox]]:
    """Lines, error bars among them, and the boxes of markers; in pixels."""
    lines, markers = [], []
    for line in ax.lines:
        path = line.get_path().transformed(line.get_transform())
        if line.get_marker() in ("None", "", None):
            lines.append(path)
        else:
            radius = 0.5 * line.get_markersize() * ax.figure.dpi / 72
            markers += [
                Bbox([point - radius, point + radius]) for point in np.asarray(path.vertices)
            ]
    for bars in ax.collections:
        lines += [path.transformed(bars.get_transform()) for path in bars.get_paths()]
    return lines, markers


def _outside(box: Bbox, of: Bbox) -> bool:
    return box.x0 < of.x0 or box.x1 > of.x1 or box.y0 < of.y0 or box.y1 > of.y1
