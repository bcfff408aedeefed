"""Many heatmaps on one sheet, with one colour scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.viz.heatmap import ANCHOR, BACKGROUND, THUMB, WRAP, Subject, draw

_INK, _GREY = (25, 25, 35), (110, 115, 125)
_ASPECT = 1.6  # of a whole sheet
_MOST_PIXELS = 8000  # of a sheet's side
_PAD = 0.05  # of a cell
_LEAST_WIDTH = 52  # letters: colour bar and legend side by side


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
    head, foot = round(4.4 * font), round(4.6 * font)
    width = max(columns * cell_pixels, _LEAST_WIDTH * font) + 2 * pad
    height = head + rows * (cell_pixels + label) + foot
    sheet = Image.new("RGB", (width, height), BACKGROUND)
    pen = ImageDraw.Draw(sheet)
    pen.text((pad, 0.7 * font), title, _INK, _font(round(1.5 * font), bold=True))
    pen.text((pad, 2.7 * font), subtitle, _GREY, _font(font))
    left = (width - columns * cell_pixels) // 2
    for k, cell in enumerate(cells):
        x = left + (k % columns) * cell_pixels
        y = head + (k // columns) * (cell_pixels + label)
        side = cell_pixels - 2 * pad
        picture = draw(cell.subject, side, side, cell.axes, top)
        sheet.paste(Image.fromarray(picture), (x + pad, y + pad))
        middle = x + cell_pixels / 2
        _centred(pen, middle, y + cell_pixels - 0.5 * font, cell.title, _INK, font, cell_pixels)
        _centred(pen, middle, y + cell_pixels + 0.8 * font, cell.note, _GREY, font, cell_pixels)
        done()
    _draw_bar(sheet, pen, pad, height - foot + font, font, top, scale)
    _draw_legend(pen, cells, width - pad, height - foot + 1.5 * font, font)
    return sheet


def _draw_bar(
    sheet: Image.Image,
    pen: ImageDraw.ImageDraw,
    x: float,
    y: float,
    font: int,
    top: float,
    scale: str,
) -> None:
    width, thick = 14 * font, round(0.9 * font)
    pen.text((x, y), scale, _INK, _font(font), anchor="lt")
    x += _font(font).getlength(scale) + font
    colours = score_colours(np.linspace(0.0, top, width), top)
    bar = Image.fromarray(np.repeat(colours[None], thick, axis=0))
    sheet.paste(bar, (round(x), round(y)))
    for k in range(6):
        at = x + k * (width - 1) / 5
        pen.line([(at, y + thick), (at, y + thick + 0.3 * font)], _GREY, 1)
        text = f"{top * k / 5:.1f}" if top >= 0.5 else f"{top * k / 5:.2g}"
        pen.text((at, y + thick + 0.5 * font), text, _GREY, _font(font), anchor="mt")


def _draw_legend(
    pen: ImageDraw.ImageDraw, cells: Sequence[Cell], right: float, y: float, font: int
) -> None:
    """From the right: what the marks mean; only marks that are on the sheet."""
    entries = [("far side", None, True), ("index and middle", WRAP, False), ("thumb", THUMB, False)]
    if any(c.subject.anchor is not None for c in cells):
        entries.append(("anchor", ANCHOR, False))
    if all(c.subject.thumb is None for c in cells):
        entries = entries[3:]
    r, x = 0.42 * font, right
    for text, colour, ring in entries:
        x -= _font(font).getlength(text)
        pen.text((x, y), text, _INK, _font(font), anchor="lm")
        x -= 1.1 * font
        box = (x - r, y - r, x + r, y + r)
        if colour == ANCHOR:
            for sign in (-1, 1):
                pen.line([(x - r, y - sign * r), (x + r, y + sign * r)], ANCHOR, round(0.3 * font))
        elif ring:
            pen.ellipse(box, outline=_INK, width=max(1, round(0.18 * font)))
        else:
            pen.ellipse(box, fill=colour, outline=_INK, width=max(1, round(0.1 * font)))
        x -= 1.3 * font


def _centred(
    pen: ImageDraw.ImageDraw,
    x: float,
    y: float,
    text: str,
    colour: tuple[int, int, int],
    size: int,
    room: float,
) -> None:
    font = _font(size)
    while text and font.getlength(text) > room:
        text = text[:-2] + "…"
    pen.text((x, y), text, colour, font, anchor="ma")  # from the ascender: one line for all


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)
