"""Many heatmaps on one sheet, with one colour scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.colours import MAP, VOID
from mjx_grasp.viz.heatmap import ANCHOR, THUMB, WRAP, Subject, draw

_INK, _GREY = "#191923", "#6e737d"
_ASPECT = 1.6  # of a whole sheet
_MOST_PIXELS = 8000  # of a sheet's side
_PAD = 0.05  # of a cell
_LEAST_WIDTH = 74  # letters: colour bar and legend side by side
_LETTER = 0.6  # width of one, of the font's size


@dataclass(frozen=True, eq=False)
class Cell:
    """One object on the sheet."""

    title: str
    note: str
    """A second line, in grey."""
    subject: Subject
    axes: Float[np.ndarray, "3 3"] | None = None
    """Camera axes; the best side if None."""


def contact_sheet(
    cells: Sequence[Cell],
    title: str,
    subtitle: str = "",
    columns: int | None = None,
    cell_pixels: int = 300,
    top: float = 1.0,
    scale: str = "score",
    done: Callable[[], None] = lambda: None,
) -> Image.Image:
    """Draws all cells on a grid, with a colour bar and a legend of the marks.

    Args:
        cells: What is drawn, row by row.
        title: Heading.
        subtitle: Second line of the heading.
        columns: Cells in a row; as many as give a sheet a screen's shape if None.
        cell_pixels: Side of a cell; made smaller where the sheet would become enormous.
        top: The score that gets the yellow end of the scale.
        scale: What the colours mean.
        done: Called after each cell, for a progress bar.

    Raises:
        InputError: There are no cells.
    """
    if not cells:
        raise InputError("cells", 0, "at least one heatmap")
    columns = columns or max(1, round(np.sqrt(_ASPECT * len(cells))))
    columns = min(columns, len(cells))
    rows = -(-len(cells) // columns)
    cell_pixels = max(48, min(cell_pixels, _MOST_PIXELS // max(columns, rows)))
    font = max(9, round(0.055 * cell_pixels))
    label, pad = round(3.0 * font), round(_PAD * cell_pixels)
    head, foot = round(4.4 * font), round(5.0 * font)
    width = max(columns * cell_pixels, _LEAST_WIDTH * font) + 2 * pad
    height = head + rows * (cell_pixels + label) + foot
    figure = Figure((width / 72, height / 72), dpi=72)  # a point is a pixel
    canvas = FigureCanvasAgg(figure)

    def write(x: float, y: float, text: str, size: float = font, **how: Any) -> None:
        """Text whose upper end is so many pixels below the sheet's."""
        how = {"color": _INK, "va": "top"} | how
        figure.text(x / width, 1.0 - y / height, text, size=size, **how)

    write(pad, 0.7 * font, title, 1.5 * font, weight="bold")
    write(pad, 2.7 * font, subtitle, color=_GREY)
    left = (width - columns * cell_pixels) // 2
    letters = int(cell_pixels / (_LETTER * font))
    for k, cell in enumerate(cells):
        x = left + (k % columns) * cell_pixels
        y = head + (k // columns) * (cell_pixels + label)
        side = cell_pixels - 2 * pad
        picture = draw(cell.subject, side, side, cell.axes, top)
        figure.figimage(picture, x + pad, height - y - pad - side)
        middle, below = x + cell_pixels / 2, y + cell_pixels
        for text, line, colour in ((cell.title, -0.5, _INK), (cell.note, 0.8, _GREY)):
            text = text if len(text) <= letters else f"{text[: letters - 1]}…"
            write(middle, below + line * font, text, color=colour, ha="center")
        done()
    bar = (pad + (_LETTER * len(scale) + 1) * font) / width, 3.0 * font / height
    axes = figure.add_axes((*bar, 14 * font / width, 0.9 * font / height))
    axes.imshow(np.linspace(0.0, top, 256)[None], MAP, extent=(0.0, top, 0.0, 1.0), aspect="auto")
    axes.spines[:].set_visible(False)
    axes.set_xticks(np.linspace(0.0, top, 6))
    axes.set_yticks([])
    axes.tick_params(labelsize=font, colors=_GREY)
    write(pad, height - 3.9 * font, scale)
    figure.legend(
        handles=_marks(cells, font),
        loc="center right",
        bbox_to_anchor=(1.0 - pad / width, 3.4 * font / height),
        ncols=5,
        handletextpad=0.1,
        columnspacing=1.0,
        borderpad=0.0,
        frameon=False,
        fontsize=font,
    )
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _marks(cells: Sequence[Cell], font: float) -> list[Line2D]:
    """Entries of the legend: only marks that are on the sheet."""

    def mark(name: str, marker: str, fill: Any, edge: Any, width: float) -> Line2D:
        return Line2D(
            [], [], linestyle="", marker=marker, label=name, markersize=0.8 * font,
            markerfacecolor=fill, markeredgecolor=edge, markeredgewidth=width * font,
        )  # fmt: skip

    anchor, thumb, wrap = (np.array(colour) / 255 for colour in (ANCHOR, THUMB, WRAP))
    marks = []
    if any(c.subject.anchor is not None for c in cells):
        marks.append(mark("anchor", "x", anchor, anchor, 0.25))
    if any(c.subject.thumb is not None for c in cells):
        marks.append(mark("thumb", "o", thumb, _INK, 0.1))
        marks.append(mark("index and middle", "o", wrap, _INK, 0.1))
        marks.append(mark("far side", "o", "none", _INK, 0.2))
    if any(np.isnan(c.subject.score).any() for c in cells):
        void = np.array(VOID) / 255
        marks.append(mark("no candidate", "s", void, void, 0.1))
    return marks
