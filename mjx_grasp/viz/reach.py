"""What a reach sweep leaves: its results file, and a plot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjx_grasp.evaluation.reach.poses import (
    SCHEMA,
    TUNING_SEEDS,
    PoseDistribution,
    SweepConfig,
)
from mjx_grasp.evaluation.reach.record import BUDGETS
from mjx_grasp.evaluation.reach.results import PAPER_RATE
from mjx_grasp.evaluation.reach.run import SweepRun
from mjx_grasp.reaching.presets import ReachPreset
from mjx_grasp.records.atomic import replacing, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.viz.plots import GREY, new_figure, png, style


def write_outputs(
    config: SweepConfig, settings: ReachPreset, robot: RobotSpec, run: SweepRun
) -> Iterator[Path]:
    """Writes what was asked for, and names each file.

    Args:
        config: What the sweep was asked for.
        settings: Those of its preset.
        robot: What reached.
        run: The sweep.
    """
    if config.out:
        facts = {
            "schema": SCHEMA,
            "provenance": provenance(config.seed),
            "robot": to_record(robot.identity),
            "tuning_seeds": TUNING_SEEDS,
            "preset": config.preset,
            "distribution": to_record(PoseDistribution()),
            "settings": to_record(settings),
        }
        write_json(config.out, facts | run.result)
        yield config.out
    if config.plot:
        with replacing(config.plot) as temporary:
            temporary.write_bytes(rate_plot(run.result, config.preset))
        yield config.plot


def rate_plot(result: dict[str, Any], label: str) -> bytes:
    """Rates over the budget, one colour per tolerance, the paper's dashed; PNG."""
    figure = new_figure(7.2, 4.4)
    axes = figure.subplots()
    style(axes)
    for k, (tolerance, ours) in enumerate(result["rate_percent"].items()):
        colour = f"C{k}"
        # Thinner one over the other: where they agree each is seen.
        width = 9.0 - 1.8 * k
        axes.plot(
            BUDGETS, list(ours.values()), color=colour, linewidth=width, label=f"{tolerance} mm"
        )
        axes.plot(BUDGETS, PAPER_RATE[tolerance], "--", color=colour, alpha=0.6)
    axes.set_ylim(-2, 102)
    axes.set_xlabel("fine-adjustment time [s]", color=GREY)
    axes.set_ylabel("reaches converged [%]", color=GREY)
    axes.set_title(f"{label} (solid) and published (dashed)", loc="left", fontsize=10, color=GREY)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    return png(figure)
