"""The grid of pose errors as a table and a picture, beside the published figures.

python experiments/pose_error_tables.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stage_tables import NOTHING, markdown

from mjx_grasp.evaluation.judging import SameStarts, mean_force, mean_success, resampled
from mjx_grasp.evaluation.results import OUTCOMES
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

PUBLISHED = {(0.0, 0.0): 89.3, (10.0, 5.0): 80.4}
"""Success of the publication's policy under the errors that it names [%]."""

_LONG_S = 8.0
"""How long the publication shows a hold."""

Error = tuple[float, float]
Cells = dict[Error, dict[str, Any]]


def summed(rows: list[dict[str, Any]]) -> Cells:
    """Success, its bootstrap interval over start states, and the force of each cell."""
    found: Cells = {}
    for at in dict.fromkeys((row["offset_mm"], row["angle_deg"]) for row in rows):
        of = [row for row in rows if (row["offset_mm"], row["angle_deg"]) == at]
        lengths = [len(row["outcomes"]) for row in of]
        trials = SameStarts(
            np.array([[c == OUTCOMES["successes"] for row in of for c in row["outcomes"]]]),
            np.array([[f for row in of for f in row["forces_n"]]], float),
            np.repeat(np.arange(len(of)), lengths),
            np.array([start for row in of for start in row["starts"]]),
        )
        weights = resampled(trials)
        success = mean_success(trials, weights)[:, 0]
        low, high = np.percentile(success[1:], (2.5, 97.5))
        force = float(mean_force(trials, weights)[0, 0])
        found[at] = {"success": success[0], "low": low, "high": high, "force": force}
    return found


def pose_errors(path: Path) -> str:
    """One line per error, one column per controller."""
    if not path.exists():
        return NOTHING
    content = read_json(path, "a table of pose errors")
    cells = {name: summed(rows) for name, rows in content["controllers"].items()}
    lines = []
    for offset, angle in next(iter(cells.values())):
        published = PUBLISHED.get((offset, angle))
        shown = (
            f"{c['success']:.1f} ({c['low']:.0f}–{c['high']:.0f}), {c['force']:.1f} N"
            for c in (of[offset, angle] for of in cells.values())
        )
        paper = "" if published is None else f"{published:.1f}"
        lines.append((f"±{offset:g} mm", f"{angle:g}°", *shown, paper))
    header = ("moved", "turned", *cells, "paper: policy")
    return markdown(Table("Pose errors", header, tuple(lines), names=2))


def stability(path: Path) -> str:
    """How long each controller holds, in the engine's usual friction and in a stiffer one."""
    if not path.exists():
        return NOTHING
    content = read_json(path, "a table of long holds")
    lines = []
    for name, impratio in dict.fromkeys((r["controller"], r["impratio"]) for r in content["rows"]):
        of = [r for r in content["rows"] if (r["controller"], r["impratio"]) == (name, impratio)]
        lifted = [row for row in of if row["held_s"] > 0]
        forces = [row["force_n"] for row in lifted if row["force_n"] is not None]
        lines.append(
            (
                name,
                f"{impratio:g}",
                f"{len(lifted)} of {len(of)}",
                f"{sum(row['held_s'] >= _LONG_S for row in lifted)}",
                f"{sum(row['held_to_the_end'] for row in lifted)}",
                f"{np.median([row['held_s'] for row in lifted]):.1f}" if lifted else "",
                f"{np.mean(forces):.1f}" if forces else "",
            )
        )
    seconds = content["settings"]["seconds"]
    header = (
        *("controller", "impratio", "lifted by 5 cm", f"held {_LONG_S:g} s more"),
        *(f"held to the end of {seconds:g} s", "held s, median", "force N"),
    )
    return markdown(Table("Long holds", header, tuple(lines), names=1))
