"""Draws the grid of pose errors, beside the published figures.

python experiments/pose_error_figure.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from paper_tables import summed
from success_curves import COLOURS, success_curve

from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.paper import POSE_ERROR
from mjx_grasp.records.atomic import read_json, replacing
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.viz.plots import GREY, new_figure, png, style

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw, and where to."""

    results: Path = ROOT / "experiments" / "results" / "pose_error.json"
    out: Path = ROOT / "docs" / "pose_error.png"


def main(config: FigureConfig) -> None:
    """Draws one panel per angle."""
    content = read_json(config.results, "a table of pose errors")
    cells = {name: summed(rows) for name, rows in content["controllers"].items()}
    angles = sorted({angle for _, angle in next(iter(cells.values()))})
    figure = new_figure(3.4 * len(angles), 3.2)
    axes = figure.subplots(1, len(angles), sharey=True, squeeze=False)[0]
    for ax, angle in zip(axes, angles, strict=True):
        style(ax)
        for colour, (name, grid) in zip(COLOURS, cells.items(), strict=False):
            at = {offset: c for (offset, turned), c in grid.items() if turned == angle}
            success_curve(ax, at, colour, name)
        paper = [(offset, s) for (offset, turned), s in POSE_ERROR.items() if turned == angle]
        if paper:
            ax.plot(
                *zip(*paper, strict=True), linestyle="", marker="*", ms=11, color="black",
                label="published policy",
            )  # fmt: skip
        ax.set_title(f"turned by up to {angle:g}°", loc="left", fontsize=10, color=GREY)
        ax.set_xlabel("moved by up to ± mm", fontsize=9, color=GREY)
        ax.set_ylim(0, 102)
    axes[0].set_ylabel("lifted and held [%]", fontsize=9, color=GREY)
    axes[0].legend(frameon=False, fontsize=8, loc="lower left", labelcolor=GREY)
    with replacing(config.out) as temporary:
        temporary.write_bytes(png(figure))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
