"""The table of a plan: how each training ended, and means over the seeds."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.statistics import bootstrap_mean_interval
from mjx_grasp.training.plan import Run
from mjx_grasp.training.plan_folders import finished

_LAST = 20
"""Iterations whose mean stands for the end of a training."""


def gathered(out: Path, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One row per finished training: how it ended, and what its evaluation says."""
    rows = []
    for run in runs:
        folder = out / run.name
        if not finished(folder):
            continue
        with (folder / "metrics.csv").open(newline="") as stream:
            last = list(csv.DictReader(stream))[-_LAST:]
        trained = {name: _mean(float(row[name]) for row in last) for name in ("success", "force_n")}
        row: dict[str, Any] = {
            "run": run.name,
            "setting": run.setting,
            "objects": run.objects,
            "seed": run.seed,
            "trained_percent": None if trained["success"] is None else 100 * trained["success"],
            "trained_force_n": trained["force_n"],
            "seconds": float(last[-1]["seconds"]),
        }
        results = folder / "results.json"
        if results.exists():
            rows_of = read_results(results).rows
            policy = [r for r in rows_of if r.controller == "policy" and r.label is None]
            row["evaluated_percent"] = _mean(100 * r.successes / r.episodes for r in policy)
            forces = (r.force_mean_n for r in policy if r.force_mean_n is not None)
            row["evaluated_force_n"] = _mean(forces)
        rows.append(row)
    return rows


def _mean(values: Iterator[float]) -> float | None:
    known = [x for x in values if x == x]
    return float(np.mean(known)) if known else None


def shown(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Mean over the seeds of each setting and set of objects, with a bootstrap interval."""
    columns = {
        "trained_percent": "trained %",
        "trained_force_n": "N",
        "evaluated_percent": "evaluated %",
        "evaluated_force_n": "N",
        "seconds": "s",
    }
    table = Table("setting", "objects", "seeds", *columns.values(), box=None)
    for setting, objects in dict.fromkeys((row["setting"], row["objects"]) for row in rows):
        of = [row for row in rows if (row["setting"], row["objects"]) == (setting, objects)]
        cells = []
        for name in columns:
            values = np.array([row[name] for row in of if row.get(name) is not None])
            text = f"{values.mean():.1f}" if len(values) else ""
            if len(values) > 1:
                low, high = bootstrap_mean_interval(values, seed=0)
                text += f" ({low:.1f}–{high:.1f})"
            cells.append(text)
        table.add_row(setting, objects, str(len(of)), *cells)
    return table
