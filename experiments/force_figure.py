"""Draws success against the contact force that it took: the shipped policy, grip and squeeze.

  python experiments/force_figure.py

reads the evaluations of the eight objects in native MuJoCo and draws `docs/success_force.png`, one
panel per condition. Other trained policies are in the tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from policy_tables import comparisons

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.tables import Column, read_groups
from mjx_grasp.records.atomic import check_writable, replacing
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.viz.plots import success_against_force

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw, and where to."""

    results: Path = ROOT / "experiments" / "results"
    """folder of the results files"""
    engine: str = "mujoco"
    """engine of the evaluations"""
    out: Path = ROOT / "docs" / "success_force.png"


def panels(folder: Path, engine: str) -> dict[str, list[Column]]:
    """The controllers of every condition.

    Raises:
        FileError: There is no evaluation in that engine.
    """
    found = {
        condition.short(): list(columns)
        for condition, columns in read_groups(comparisons(folder)).items()
        if condition.engine == engine
    }
    if not found:
        raise FileError(folder, f"no eight_*.json of {engine}", "evaluations of the eight objects")
    return found


def main(config: FigureConfig) -> None:
    """The command."""
    check_writable("--out", config.out)
    picture = success_against_force(panels(config.results, config.engine))
    with replacing(config.out) as temporary:
        temporary.write_bytes(picture)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
