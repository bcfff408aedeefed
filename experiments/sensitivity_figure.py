"""Draws success and force over what differs from the model.

python experiments/sensitivity_figure.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.ticker import NullLocator
from sensitivity_tables import FACTORS, curves
from success_curves import COLOURS, success_curve

from mjx_grasp.cli import run_command
from mjx_grasp.records.atomic import read_json, replacing
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.viz.plots import GREY, new_figure, png, style

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw, and where to."""

    results: Path = ROOT / "experiments" / "results" / "sensitivity.json"
    out: Path = ROOT / "docs" / "sensitivity.png"


def main(config: FigureConfig) -> None:
    """Draws one column per factor: success above, force below."""
    content = read_json(config.results, "a table of sensitivities")
    found, nominal = curves(content), content["nominal"]
    shown = [factor for factor in FACTORS if any(factor in of for of in found.values())]
    figure = new_figure(2.9 * max(len(shown), 1), 5.4)
    axes = figure.subplots(2, max(len(shown), 1), sharex="col", sharey="row", squeeze=False)
    for factor, (upper, lower) in zip(shown, axes.T, strict=True):
        for ax in (upper, lower):
            style(ax)
            ax.axvline(nominal[factor], color=GREY, linewidth=0.8, linestyle=":")
        for colour, (name, of) in zip(COLOURS, found.items(), strict=False):
            curve = of.get(factor, {})
            success_curve(upper, curve, colour, name)
            forces = [cell["force"] for cell in curve.values()]
            lower.plot(list(curve), forces, color=colour, marker="o", ms=3.5)
        called, how = FACTORS[factor]
        values = sorted({x for of in found.values() for x in of.get(factor, {})})
        upper.set_title(called, loc="left", fontsize=10, color=GREY)
        lower.set_xscale("log")
        lower.set_xticks(values, [how.format(x) for x in values])
        lower.xaxis.set_minor_locator(NullLocator())
    axes[0, 0].set_ylim(0, 102)
    axes[1, 0].set_ylim(0, None)
    axes[0, 0].set_ylabel("lifted and held [%]", fontsize=9, color=GREY)
    axes[1, 0].set_ylabel("force per finger [N]", fontsize=9, color=GREY)
    axes[0, 0].legend(  # on white: the nominal value's line passes behind it
        facecolor="white", framealpha=1, edgecolor="none", fontsize=8, loc="lower right",
        labelcolor=GREY,
    )  # fmt: skip
    with replacing(config.out) as temporary:
        temporary.write_bytes(png(figure))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
