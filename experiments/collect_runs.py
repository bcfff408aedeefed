"""Keeps one row per training run: setting, speed, and where success and force ended.

  python experiments/collect_runs.py runs/A runs/B

adds the runs to `experiments/results/training_runs.json`; a run that is there already is replaced,
another one of its name is refused unless `--replace` is given.
Success and force here are those of the training's own episodes, with exploration noise.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig
from mjx_grasp.training.config import stored_config

SCHEMA = "mjx_grasp.training_runs/1"
_LAST = 20  # iterations that the final figures are averaged over


@dataclass(frozen=True)
class CollectConfig(CommandSettings):
    """Which runs to add."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """folders of finished runs"""
    out: Path = Path("experiments/results/training_runs.json")
    replace: bool = False
    """also put a run in the place of another one of its name: for who evaluates it anew as well"""


def run_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a table of runs; those written before runs named their task say it too.

    Raises:
        FileError: The file cannot be read.
    """
    return [_with_task(row) for row in read_json(path, "a table of runs")["rows"]]


def _with_task(row: dict[str, Any]) -> dict[str, Any]:
    """A row that says what was learnt; without a word of it, its preset does."""
    if row.get("preset") != "end-to-end":
        return _BY_PARTS | row
    return _BY_PARTS | {"task": "end_to_end"} | _FIRST | row


_BY_PARTS = {"task": "closing", "curriculum": None, "assisted": None}
_FIRST = {"reach_rate": 0.5, "all_joints": False, "raised": 0.0}
"""What end-to-end trainings had before these were settings."""


def run_row(folder: Path) -> dict[str, Any]:
    """The row of a run.

    Raises:
        FileError: The folder lacks a run's files, or the run is not finished.
    """
    try:
        config = stored_config(folder)
        made = read_json(folder / "provenance.json", "the provenance of a run")
        with (folder / "metrics.csv").open(newline="") as stream:
            metrics = list(csv.DictReader(stream))
    except (OSError, csv.Error) as error:
        raise FileError(
            folder, f"no finished run ({error})", "config, provenance, metrics"
        ) from None
    ppo = config.ppo
    if len(metrics) != ppo.iterations:
        raise FileError(folder, f"{len(metrics)} iterations", f"all {ppo.iterations} of them")

    def last(name: str) -> float:
        return float(np.nanmean([float(r[name]) for r in metrics[-_LAST:]]))

    return {
        "run": folder.name,
        "preset": config.preset,
        **_task(config.task),
        "engine": config.engine,
        "worlds": ppo.worlds,
        "unroll": ppo.unroll,
        "residual": config.task.action.residual,
        "physics_dt": config.scene.physics_dt,
        "privileged_critic": ppo.privileged_critic,
        "seed": config.seed,
        "objects": config.objects,
        "start_from": config.start_from and Path(config.start_from).name,
        "solver_iterations": config.scene.solver_iterations,
        "env_steps": int(float(metrics[-1]["env_steps"])),
        "seconds_with_compilation": float(metrics[-1]["seconds"]),
        "steps_per_s": float(np.median([float(r["steps_per_s"]) for r in metrics])),
        "training_success_percent": 100.0 * last("success"),
        "training_force_n": last("force_n"),
        "return": last("return"),
        "broken_worlds": sum(float(r["broken_worlds"]) for r in metrics),
        "overflows": sum(float(r["overflows"]) for r in metrics),
        "provenance": made,
    }


def _task(config: ClosingTaskConfig) -> dict[str, Any]:
    """What was learnt, and by which means where one policy does all."""
    if not isinstance(config, EndToEndConfig):
        return dict(_BY_PARTS)
    arm = config.action.arm_rate if config.reach_rate is None else config.reach_rate
    return {
        "task": "end_to_end",
        "curriculum": config.curriculum.kind,
        "assisted": config.assisted,
        "reach_rate": arm,
        "all_joints": config.action.others,
        "raised": config.raised,
    }


def _check_same(row: dict[str, Any], known: dict[str, Any]) -> None:
    """Refuses a run whose name another one has, which may have results of its own elsewhere.

    Raises:
        InputError: It is another training than that of the table.
    """
    then, now = known.get("provenance"), row["provenance"]
    if then is not None and any(then[x] != now[x] for x in ("command", "git", "seed")):
        of = f"this one is that of `{then['command']}` at {then['git']}"
        expected = f"another folder name, or --replace; {of}"
        raise InputError("runs", row["run"], expected)


def main(config: CollectConfig) -> None:
    """Adds the runs and prints the table.

    Raises:
        FileError: A folder holds no finished run.
        InputError: A run has the name of another; nothing is added then.
    """
    rows: dict[str, dict[str, Any]] = {}
    if config.out.exists():
        rows = {r["run"]: r for r in run_rows(config.out)}
    for row in map(run_row, config.runs):
        if not config.replace:
            _check_same(row, rows.get(row["run"], {}))
        rows[row["run"]] = row
    document = {"schema": SCHEMA, "rows": list(rows.values()), "provenance": provenance(seed=0)}
    write_json(config.out, document)
    print(f"{len(rows)} runs in {config.out}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(CollectConfig, description=__doc__)))
