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
from mjx_grasp.evaluation.judging import resampled, same_starts, success_within
from mjx_grasp.evaluation.results import ResultRow, read_results
from mjx_grasp.records.settings import CommandSettings, Several
from mjx_grasp.records.table import Table

WITHIN = np.array([2.0, 3.0, 4.0, np.inf])
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
    settings: dict[tuple, dict[float | None, list[ResultRow]]] = {}
    for row in rows:
        at = (row.offset_mm, row.angle_deg, row.friction, row.mass_scale, row.robot_errors)
        settings.setdefault(at, {}).setdefault(row.force_budget_n, []).append(row)
    return float(np.mean([_of_condition(list(of.values())) for of in settings.values()]))


def _of_condition(settings: Sequence[Sequence[ResultRow]]) -> float:
    trials = same_starts(settings)
    weights = resampled(trials, resamples=0)
    return float(np.mean(success_within(trials, weights, range(len(settings)), WITHIN)))


def ranked(folders: Sequence[Path]) -> list[tuple[str, list[float]]]:
    """Policies with their points in each comparison, the best first.

    Raises:
        FileError: A folder is missing, or no policy is in all of them.
    """
    for folder in folders:
        if not folder.is_dir():
            raise FileError(folder, "no folder", "one with a results file per policy")
    names = [{path.stem for path in folder.glob("*.json")} for folder in folders]
    common = sorted(set.intersection(*names))
    if not common:
        raise FileError(folders[0], "no policy that is in all folders", "a file of the same name")
    found = [(name, [points(f / f"{name}.json") for f in folders]) for name in common]
    return sorted(found, key=lambda of: -np.mean(of[1]))


def points_table(folders: Sequence[Path], ranking: Sequence[tuple[str, list[float]]]) -> Table:
    """The ranking, with the mean where there are several comparisons."""
    header = ("policy", *(folder.name for folder in folders))
    lines = [(name, *(f"{p:.1f}" for p in of)) for name, of in ranking]
    if len(folders) > 1:
        header += ("mean",)
        lines = [
            (*line, f"{np.mean(of):.1f}") for line, (_, of) in zip(lines, ranking, strict=True)
        ]
    return Table("Points", header, tuple(lines))


def main(config: ChooseConfig) -> None:
    """Prints the ranking, and the best on the last line."""
    console, ranking = Console(), ranked(config.folders)
    console.print(points_table(config.folders, ranking))
    console.print(ranking[0][0])


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ChooseConfig, description=__doc__)))
