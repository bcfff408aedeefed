"""Draws success against contact force: the shipped policy, grip and squeeze, a panel per condition.

  python experiments/force_figure.py

reads the evaluations of the eight objects in native MuJoCo and draws `docs/success_force.png`,
success against the force that it took, and `docs/success_within.png`, the share of trials that are
lifted within a force. Other trained policies are in the tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from closing_tables import with_more
from policy_tables import comparisons

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.conditions import Groups, read_groups
from mjx_grasp.evaluation.front_tables import front_panels
from mjx_grasp.records.atomic import check_writable, replacing
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.viz.plots import success_against_force, success_within_budgets

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw, and where to."""

    results: Path = ROOT / "experiments" / "results"
    """folder of the results files"""
    engine: str = "mujoco"
    """engine of the evaluations"""
    out: Path = ROOT / "docs" / "success_force.png"
    within: Path = ROOT / "docs" / "success_within.png"


def evaluated(folder: Path, engine: str) -> Groups:
    """The controllers of every condition.

    Raises:
        FileError: There is no evaluation in that engine.
    """
    told = read_groups(sorted(folder.glob("not_kept/*.json")))
    found = {
        condition: columns
        for condition, columns in with_more(read_groups(comparisons(folder)), told).items()
        if condition.engine == engine
    }
    if not found:
        raise FileError(folder, f"no eight_*.json of {engine}", "evaluations of the eight objects")
    return found


def main(config: FigureConfig) -> None:
    """The command."""
    check_writable("--out", config.out)
    check_writable("--within", config.within)
    groups = evaluated(config.results, config.engine)
    by_force = {condition.short(): columns for condition, columns in groups.items()}
    for path, picture in (
        (config.out, success_against_force(by_force)),
        (config.within, success_within_budgets(front_panels(groups))),
    ):
        with replacing(path) as temporary:
            temporary.write_bytes(picture)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
