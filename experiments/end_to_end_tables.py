"""Tables of end-to-end policies: their trainings, and their success from home.

The results files are those of `evaluate_controllers.py` in `results/end_to_end`; a file names the
policy, and with it the run, in its command.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from collect_runs import run_rows
from markdown_tables import NOTHING, markdown, read, short_revision
from policy_tables import named_run

from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import Column, read_groups
from mjx_grasp.evaluation.grasps.scenario import NOMINAL
from mjx_grasp.records.table import Table

_LIGHT_N = 0.5
"""Mean force per finger below which a finger hardly presses."""
_BAR = 30.0
"""What we had asked of a policy to call it one that grasps [%]."""


def from_home(folder: Path) -> dict[str, Column]:
    """The evaluated end-to-end policies by their run, in the order of the table of runs.

    Args:
        folder: The results files.

    Raises:
        FileError: A file cannot be read.
    """
    found = {}
    for path in sorted((folder / "end_to_end").glob("*.json")):
        columns = [c for of in read_groups([path]).values() for c in of if c.family == "policy"]
        if columns and (run := named_run(path)) is not None:
            found[run] = columns[0]
    order = [row["run"] for row in _trained(folder)]
    return dict(sorted(found.items(), key=lambda item: [*order, item[0]].index(item[0])))


def _trained(folder: Path) -> list[dict[str, Any]]:
    """The rows of end-to-end trainings."""
    path = folder / "training_runs.json"
    rows = run_rows(path) if path.exists() else []
    return [row for row in rows if row["task"] == "end_to_end"]


def trainings(folder: Path) -> str:
    """One line per end-to-end training, with what became of the policy from home."""
    rows = _trained(folder)
    if not rows:
        return NOTHING
    judged = from_home(folder)
    lines = tuple(_training(row, judged.get(row["run"])) for row in rows)
    header = (
        *("run", "curriculum", "assisted", "arm before the lift rad/s", "joints", "way", "objects"),
        *("worlds × unroll", "device", "seed", "M steps", "s", "steps/s", "return"),
        *("success in training %", "from home, native %", "git"),
    )
    return markdown(Table("End-to-end trainings", header, lines, names=9))


def _training(row: dict[str, Any], judged: Column | None) -> tuple[str, ...]:
    return (
        row["run"],
        row["curriculum"] or "",
        "yes" if row["assisted"] else "no",
        f"{row['reach_rate']:g}",
        "all" if row["all_joints"] else "closing's",
        "over the object" if row["raised"] else "straight",
        " ".join(row["objects"]),
        f"{row['worlds']:,} × {row['unroll']}",
        str(row["provenance"]["device"]),
        str(row["seed"]),
        f"{row['env_steps'] / 1e6:.1f}",
        f"{row['seconds_with_compilation']:.0f}",
        f"{row['steps_per_s']:,.0f}",
        f"{row['return']:,.0f}",
        f"{row['training_success_percent']:.1f}",
        "" if judged is None else _rate(*judged.mean()),
        short_revision(row["provenance"]),
    )


def success_from_home(folder: Path) -> str:
    """Success object by object beside the system of parts, and how far the failures came."""
    judged = from_home(folder)
    if not judged:
        return NOTHING
    parts = _by_parts(folder / "scenarios.json")
    names = list(dict.fromkeys(name for column in judged.values() for name in column.rows))
    lines = []
    for name in names:
        rows = [column.rows.get(name) for column in judged.values()]
        cells = ["" if row is None else _rate(row.success_percent, row.ci95) for row in rows]
        lines.append((name.replace("_", " "), *cells, parts.get(name, ""), ""))
    # A mean over other objects than the publication's is not to be held against its own.
    complete = names and paper.OBJECTS.keys() == set(names)
    means = [_rate(*column.mean()) for column in judged.values()]
    ends = (parts.get("all", ""), f"{paper.END_TO_END:g}") if complete else ("", "")
    lines.append(("mean", *means, *ends))
    header = ("object", *judged, "by parts", "paper: end to end")
    table = Table("Success from home", header, tuple(lines), summary=1)
    told = "\n".join(f"- {_failures(run, column)}" for run, column in judged.items())
    return f"{markdown(table)}\n\n{told}\n\n{_verdict(judged)}"


def best(judged: dict[str, Column]) -> tuple[str, float]:
    """The run that does best from home, and its mean success [%]."""
    run = max(judged, key=lambda name: judged[name].mean()[0])
    return run, judged[run].mean()[0]


def bar_is_met(judged: dict[str, Column]) -> bool:
    """Whether some policy succeeds as often as we had asked for."""
    return best(judged)[1] >= _BAR


def _verdict(judged: dict[str, Column]) -> str:
    run, success = best(judged)
    met = "meets" if bar_is_met(judged) else "misses"
    return f"The best, `{run}` with {success:.1f} %, {met} the {_BAR:g} % that we had asked for."


def _failures(run: str, column: Column) -> str:
    rows = list(column.rows.values())
    trials, lifted = sum(r.episodes for r in rows), sum(r.successes for r in rows)
    never = sum(r.never_lifted for r in rows)
    forces = [force for r in rows for force in r.forces_n if force is not None]
    means = [r.force_mean_n for r in rows if r.force_mean_n is not None]
    light = sum(force < _LIGHT_N for force in forces)
    text = f"`{run}`: {lifted} of {trials} trials succeed, {never} never lift the object"
    if any(r.forces_n for r in rows):
        text += (
            f". The lift begins in {len(forces)}, with {np.mean(means):.1f} N a finger in the mean "
            f"over the objects, and in {light} of these the fingers press with less than "
            f"{_LIGHT_N:g} N on average"
        )
    return f"{text}."


def _by_parts(path: Path) -> dict[str, str]:
    """Whole grasps from home by the modular system while nothing happens."""
    record = read(path)
    if record is None:
        return {}
    nominal = record["scenarios"][NOMINAL]
    found = {**nominal["objects"], "all": nominal["all"]}
    return {name: _rate(s["success_percent"], s["ci95"]) for name, s in found.items()}


def _rate(percent: float, interval: tuple[float, float]) -> str:
    return f"{percent:.1f} ({interval[0]:.0f}–{interval[1]:.0f})"
