"""Success on every object that has start states, those of training and those kept out of it.

The results file is that of `evaluate_controllers.py` from reached states of all objects; that of
the heaviest ones is of `heavy_objects.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markdown_tables import NOTHING, markdown

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import NOT_KEPT, POLICIES
from mjx_grasp.evaluation.results import ResultRow, read_results
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

_PARTS = {
    "train": "training",
    "held_out": "held out",
    "scaled": "scaled copy",
    "figure_only": "for figures",
}
_MEANS = ("train", "held_out")


class Controller(NamedTuple):
    """What tells controllers of a file apart."""

    family: str
    force: float | None
    """budget of a policy, or what a squeeze commands [N]"""

    @property
    def name(self) -> str:
        """In a table's header."""
        if self.force is None:
            return self.family
        what = f"{self.family}, budget" if self.family in POLICIES else self.family
        return f"{what} {self.force:g} N"


def _of(row: ResultRow) -> Controller:
    forces = {"policy": row.force_budget_n, "squeeze": row.squeeze_force_n}
    family = row.controller + (NOT_KEPT if row.told_alone else "")
    return Controller(family, forces.get(row.controller))


def objects(path: Path) -> str:
    """One line per object, one column per controller; then the means of both parts.

    Args:
        path: The results file.

    Raises:
        FileError: It cannot be read.
    """
    if not path.exists():
        return NOTHING
    results, catalogue = read_results(path), load_catalogue()
    columns: dict[Controller, dict[str, ResultRow]] = {}
    for row in results.rows:
        columns.setdefault(_of(row), {})[row.object] = row
    names = sorted(
        dict.fromkeys(row.object for row in results.rows),
        key=lambda name: list(_PARTS).index(catalogue[name].split),
    )
    lines = []
    for name in names:
        mass = f"{catalogue[name].mass:.2f}"
        rows = [of.get(name) for of in columns.values()]
        cells = *(_cell(row) for row in rows), f"{_by_any(rows):.0f}", ""
        lines.append((name.replace("_", " "), _PARTS[catalogue[name].split], mass, *cells))
    means = [line for part in _MEANS if (line := _mean(part, names, columns)) is not None]
    header = (
        *("object", "part", "mass kg", *(column.name for column in columns)),
        *("any of these", "paper: policy / squeeze"),
    )
    table = Table("Objects", header, (*lines, *means), summary=len(means), names=2)
    without = ", ".join(n.replace("_", " ") for n in results.extra.get("not_eligible", ()))
    return markdown(table) + (f"\n\nWithout start states: {without}." if without else "")


def _cell(row: ResultRow | None) -> str:
    if row is None:
        return ""
    force = "" if row.force_mean_n is None else f", {row.force_mean_n:.1f} N"
    low, high = row.ci95
    return f"{100 * row.successes / row.episodes:.0f} ({low:.0f}–{high:.0f}){force}"


def _by_any(rows: Sequence[ResultRow | None]) -> float:
    """The share of trials in which at least one controller lifted the object [%]."""
    letters = [row.outcomes for row in rows if row is not None]
    lifted = ["S" in trial for trial in zip(*letters, strict=True)]
    return 100.0 * float(np.mean(lifted))


def _mean(
    part: str, names: list[str], columns: dict[Controller, dict[str, ResultRow]]
) -> tuple[str, ...] | None:
    """Means over the objects of a part, each of which counts the same."""
    catalogue = load_catalogue()
    own = [name for name in names if catalogue[name].split == part]
    if not own:
        return None
    cells = []
    for of in columns.values():
        rows = [of[name] for name in own if name in of]
        success = np.mean([100 * row.successes / row.episodes for row in rows]) if rows else np.nan
        forces = [row.force_mean_n for row in rows if row.force_mean_n is not None]
        cells.append(f"{success:.1f}" + (f", {np.mean(forces):.1f} N" if forces else ""))
    by_any = np.mean([_by_any([of.get(name) for of in columns.values()]) for name in own])
    policy, squeeze = paper.ALL_ELIGIBLE
    published = f"{policy:g} / {squeeze:g}" if part == "train" else ""
    return f"mean of {len(own)}", _PARTS[part], "", *cells, f"{by_any:.1f}", published


def trained(shipped: Path, paths: Sequence[Path]) -> str:
    """Means of policies trained on all objects, beside those of the shipped one.

    Args:
        shipped: Results file of the shipped policy.
        paths: Of each of the others, from the same states; named after the run.

    Raises:
        FileError: One cannot be read, or is from other start states.
    """
    if not (shipped.exists() and paths):
        return NOTHING
    catalogue, lines = load_catalogue(), []
    asked = read_results(shipped).extra["sha256"]["handoffs"]
    for name, path in (("shipped", shipped), *((path.stem, path) for path in paths)):
        results, columns = read_results(path), dict[Controller, dict[str, ResultRow]]()
        if (states := results.extra["sha256"]["handoffs"]) != asked:
            raise FileError(path, f"start states {states[:8]}", f"those of {shipped.name}")
        for row in results.rows:
            columns.setdefault(_of(row), {})[row.object] = row
        for controller, of in columns.items():
            cells = []
            for part in _MEANS:
                rows = [row for row in of.values() if catalogue[row.object].split == part]
                success = np.mean([100 * row.successes / row.episodes for row in rows])
                forces = [row.force_mean_n for row in rows if row.force_mean_n is not None]
                cells.append(f"{success:.1f} at {np.mean(forces):.1f} N")
            lines.append((f"{name}: {controller.name}", *cells))
    header = "controller", *(f"{_PARTS[part]} objects" for part in _MEANS)
    return markdown(Table("Trained on all objects", header, tuple(lines)))


def statics(path: Path) -> str:
    """For each object, the force that its start states need, and how many no force can hold.

    Args:
        path: Results file of `least_force.py`, of one friction.

    Raises:
        FileError: It cannot be read.
    """
    if not path.exists():
        return NOTHING
    lines, shares = [], []
    for row in read_json(path, "a results file")["rows"]:
        forces = [force for force in row["forces_n"] if force is not None]
        shares.append(100 * len(forces) / len(row["forces_n"]))
        need = f"{np.median(forces):.1f}" if forces else ""
        lines.append((row["object"].replace("_", " "), need, f"{shares[-1]:.0f}"))
    lines.append(("mean", "", f"{np.mean(shares):.1f}"))
    header = "object", "least force N", "states that some force holds %"
    return markdown(Table("Statics", header, tuple(lines), summary=1))


def heavy(path: Path) -> str:
    """Success on the heaviest objects, a line for each, a column for each grip and finger strength.

    Args:
        path: The results file.

    Raises:
        FileError: It cannot be read.
    """
    if not path.exists():
        return NOTHING
    rows = read_json(path, "results of heavy objects")["rows"]
    columns = list(dict.fromkeys((row["most_n"], row["finger_torque"]) for row in rows))
    cells: dict[str, dict[tuple[float, float], str]] = {}
    for row in rows:
        held = "" if row["force_held_n"] is None else f" at {row['force_held_n']:.1f} N"
        share = f"{100 * row['successes'] / row['episodes']:.0f}{held}"
        cells.setdefault(row["object"], {})[row["most_n"], row["finger_torque"]] = share
    mass = {row["object"]: row["mass_kg"] for row in rows}
    lines = tuple(
        (name.replace("_", " "), f"{mass[name]:.2f}", *(of[column] for column in columns))
        for name, of in sorted(cells.items(), key=lambda item: -mass[item[0]])
    )
    header = ("object", "mass kg", *(f"up to {most:g} N, torque × {t:g}" for most, t in columns))
    return markdown(Table("Heavy objects", header, lines, names=1))
