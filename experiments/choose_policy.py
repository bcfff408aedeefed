"""Which of several policies to ship: the best by success within several forces.

Every policy has been tried from the same training states, under several force budgets and
conditions (`evaluate_controllers.py --states training`). Its points under a condition are the
means of its success within 2, 3 and 4 N per finger and at any force, each at the best of its
budgets, objects counting alike; then conditions count alike, and after them the comparisons, of
which each has a folder with a file per policy. A policy that is missing from one of them is left
out.

  cd experiments/results/choice && python ../../choose_policy.py planned all
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.results import OUTCOMES, ResultRow, read_results
from mjx_grasp.records.settings import CommandSettings, Several
from mjx_grasp.records.table import Table

WITHIN = (2.0, 3.0, 4.0, float("inf"))
"""mean forces per finger within which success counts [N]"""


@dataclass(frozen=True)
class ChooseConfig(CommandSettings):
    """What to choose from."""

    folders: tyro.conf.Positional[Annotated[tuple[Path, ...], Several()]]
    """comparisons: in each a results file per policy, of the same name in all of them"""


def points(path: Path) -> float:
    """A policy's points in one comparison [%].

    Args:
        path: Results of the policy under several budgets.

    Raises:
        FileError: It is unreadable, or has no row of a policy.
    """
    rows = [row for row in read_results(path).rows if row.controller == "policy"]
    if not rows:
        raise FileError(path, "no row of a policy", "rows of one under several force budgets")
    conditions = sorted({(row.offset_mm, row.angle_deg, row.friction) for row in rows})
    return float(
        np.mean([_of_condition([r for r in rows if _condition(r) == at]) for at in conditions])
    )


def _condition(row: ResultRow) -> tuple[float, float, float]:
    return row.offset_mm, row.angle_deg, row.friction


def _of_condition(rows: Sequence[ResultRow]) -> float:
    budgets = {row.force_budget_n for row in rows}
    best = [
        max(
            np.mean([_share(row, most) for row in rows if row.force_budget_n == budget])
            for budget in budgets
        )
        for most in WITHIN
    ]
    return 100 * float(np.mean(best))


def _share(row: ResultRow, most: float) -> float:
    """Of the trials, those that are lifted with at most that mean force."""
    trials = zip(row.outcomes, row.forces_n, strict=True)
    return float(np.mean([o == OUTCOMES["successes"] and (f or 0.0) <= most for o, f in trials]))


def ranked(folders: Sequence[Path]) -> list[tuple[str, list[float]]]:
    """Policies with their points in each comparison, the best first.

    Raises:
        FileError: No policy is in all of them.
    """
    names = [{path.stem for path in folder.glob("*.json")} for folder in folders]
    common = sorted(set.intersection(*names))
    if not common:
        raise FileError(folders[0], "no policy that is in all folders", "a file of the same name")
    found = [(name, [points(f / f"{name}.json") for f in folders]) for name in common]
    return sorted(found, key=lambda of: -np.mean(of[1]))


def points_table(folders: Sequence[Path]) -> Table:
    """The ranking."""
    lines = [
        (name, *(f"{p:.1f}" for p in of), f"{np.mean(of):.1f}") for name, of in ranked(folders)
    ]
    return Table("Points", ("policy", *(f.name for f in folders), "mean"), tuple(lines))


def main(config: ChooseConfig) -> None:
    """Prints the ranking, and the best on the last line."""
    console = Console()
    console.print(points_table(config.folders))
    console.print(ranked(config.folders)[0][0])


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ChooseConfig, description=__doc__)))
