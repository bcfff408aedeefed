"""What each part of the method contributes to whole grasps, for the README."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markdown_tables import NOTHING, markdown, read

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.results import OUTCOMES
from mjx_grasp.evaluation.judging import Estimate, SameStarts, gain, resampled
from mjx_grasp.records.table import Table

FULL = "full"
"""The variant that leaves out nothing."""
Result = Mapping[str, Any]
"""Of a variant under a scenario, as the results file has it."""

_SAID = (
    "{trials} trials per cell, {what}. Success in %, and the difference to the full system in "
    "percentage points with its 95 % bootstrap interval over the poses, which are the same for all."
)


def pipeline_ablation(path: Path) -> str:
    """The full system and what is left out of it: success, and how each variant fails."""
    d = read(path)
    if d is None:
        return NOTHING
    results, asked = d["results"], d["config"]
    scenarios = list(dict.fromkeys(at for of in results.values() for at in of))
    of_full = results.get(FULL, {})
    lines, details = [], []
    for name, of in results.items():
        cells = []
        for at in scenarios:
            cells.append(_cell(path, of.get(at), None if name == FULL else of_full.get(at)))
            if at in of:
                details.append((f"`{name}`", at.replace("_", " "), *_detail_cells(of[at]["all"])))
        lines.append((f"`{name}`: {d['variants'][name]}", *cells))
    first = next(iter(next(iter(results.values())).values()))
    what = "real scans" if asked["objects_dir"] else "parametric stand-ins"
    said = _SAID.format(trials=first["all"]["trials"], what=what)
    main = Table("Ablation", ("", *(at.replace("_", " ") for at in scenarios)), tuple(lines))
    header = ("variant", "scenario", "lifted s", "force N", *(_words(o) for o in OUTCOMES[1:]))
    return (
        f"{said}\n\n{markdown(main)}\n\n<details><summary>Times, forces and failures</summary>\n\n"
        f"{markdown(Table('Failures', header, tuple(details), names=2))}\n\n</details>"
    )


def steering_adds(path: Path) -> str:
    """What asking for a place brings to whole grasps, and what it costs, from paired trials."""
    d = read(path)
    if d is None:
        return NOTHING
    default, steered = (
        [row for row in d["rows"] if row["steering"] == way] for way in ("default", "contacts")
    )
    try:
        cost = difference({"rows": default}, {"rows": steered})
    except ValueError as error:
        raise FileError(path, str(error), "trials in pairs") from None
    apart = (
        np.median([row["achieved_mm"] for row in rows if row["achieved_mm"] is not None])
        for rows in (default, steered)
    )
    before, after = apart
    objects = len({row["object"] for row in default})
    return (
        f"Steering has trials of its own, {len(default)} pairs of {objects} objects: asked for a "
        f"part or a side, the pads are {after:.1f} mm from it as the lift begins, in the median, "
        f"instead of {before:.1f} mm without being asked; success changes by {cost.text()} points, "
        "every object counting the same."
    )


def difference(full: Result, other: Result) -> Estimate:
    """By how much a variant succeeds more often than the full system, on the same poses [points].

    Raises:
        ValueError: Their objects differ.
    """
    both = [of["rows"] for of in (other, full)]
    names = [[row["object"] for row in rows] for rows in both]
    if names[0] != names[1]:
        raise ValueError("trials of other objects than the full system's")
    trials = SameStarts(
        np.array([[row["outcome"] == "success" for row in rows] for rows in both]),
        np.array([[row["force_mean_n"] for row in rows] for rows in both], float),
        np.unique(names[0], return_inverse=True)[1],
        np.arange(len(names[0])),
    )
    return gain(trials, resampled(trials), 0, 1)


def _cell(path: Path, of: Result | None, full: Result | None) -> str:
    """Success, and what it is beside the full system's."""
    if of is None:
        return ""
    success = f"{of['all']['success_percent']:.1f}"
    if full is None:
        return success
    try:
        return f"{success}, {difference(full, of).text()}"
    except ValueError as error:
        raise FileError(path, str(error), "trials in pairs") from None


def _detail_cells(sums: Mapping[str, Any]) -> tuple[str, ...]:
    times = ("" if sums[k] is None else f"{sums[k]:.1f}" for k in ("lifted_s", "force_mean_n"))
    return *times, *(str(sums[outcome]) for outcome in OUTCOMES[1:])


def _words(outcome: str) -> str:
    return outcome.replace("_", " ")
