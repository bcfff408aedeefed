"""What separates the published preset from its publication, for the README."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markdown_tables import NOTHING, markdown
from policy_tables import in_words

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation import paper
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

_MANY = 3
"""changes that are not said once more where another setting has them all"""
_PAPER = (
    "Trainings of the preset `paper` in steps of 5 ms, {seeds} seeds of {steps:.1f} M steps each, "
    "that differ from it in what the first column says. Each policy lifts the eight in native "
    "MuJoCo in steps of 2 ms, from {trials} starts per condition that none has begun from, in the "
    "task that it was trained in: success, mean over the seeds (each of them), at the mean force "
    "in N. *As trained* has the friction, robot and errors of the training itself. A squeeze of so "
    "many newtons has the same task, and no policy. The publication's best of eighteen lifts "
    "{published:.1f} %."
)


def paper_ablation(path: Path) -> str:
    """What separates the published preset from its publication, a line per setting."""
    if not path.exists():
        return NOTHING
    rows = read_json(path, "an ablation table")["rows"]
    conditions = [e["condition"] for e in rows[0]["evaluations"]]
    settings: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        settings.setdefault(row["run"].rsplit("-seed", 1)[0], []).append(row)
    changes = {name: _changes(of[0], settings["reference"][0]) for name, of in settings.items()}
    lines = []
    for name in sorted(settings, key=lambda name: (len(changes[name]), name)):
        of, words = settings[name], _told(name, changes)
        cells = []
        for condition in conditions:
            found = [e for row in of for e in row["evaluations"] if e["condition"] == condition]
            shares = [e["success_percent"] for e in found]
            each = ", ".join(f"{share:.0f}" for share in sorted(shares, reverse=True))
            force = np.mean([e["force_mean_n"] for e in found])
            cells.append(f"{np.mean(shares):.1f} ({each}) at {force:.1f}")
        squeezes = [
            f"{e['success_percent']:.1f} at {e['force_mean_n']:.1f} of {e['squeeze_n']:g}"
            for e in of[0].get("squeezes", ())
        ]
        lines.append((f"`{name}`" + (f": {words}" if words else ""), *cells, ", ".join(squeezes)))
    counts, lengths = {len(of) for of in settings.values()}, {row["env_steps"] for row in rows}
    if len(counts) > 1 or max(lengths) > 1.01 * min(lengths):
        expected = "as many seeds of each, all of about the same length"
        raise FileError(path, f"{sorted(counts)} seeds of {sorted(lengths)} steps", expected)
    said = _PAPER.format(
        seeds=counts.pop(),
        steps=1e-6 * min(lengths),
        trials=rows[0]["evaluations"][0]["trials"],
        published=paper.MEAN.ours,
    )
    header = ("setting", *conditions, "squeezes in the same task, nominal")
    return f"{said}\n\n{markdown(Table('Ablation', header, tuple(lines)))}"


def _changes(row: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """In words each setting in which a training differs from another one, start states too."""
    mine, theirs = (each["trained"] for each in (row, other))
    changes = {}
    if mine["sha256"].get("handoffs") != theirs["sha256"].get("handoffs"):
        words = [*shlex.split(mine["command"]), ""]
        given = words.index("--handoffs") + 1 if "--handoffs" in words else -1
        changes["handoffs"] = f"`{words[given]}`" if words[given] else "its own"
    same = other["changes"].items()
    changes |= {k: value for k, value in row["changes"].items() if (k, value) not in same}
    changes |= {k: "as the preset" for k in other["changes"] if k not in row["changes"]}
    return [f"`{name}` {in_words(value)}" for name, value in changes.items()]


def _told(name: str, changes: Mapping[str, Sequence[str]]) -> str:
    """What a setting changes, beside all that another one does which is worth naming."""
    own = changes[name]
    within = [k for k, of in changes.items() if _MANY < len(of) < len(own) and {*of} < {*own}]
    if not within:
        return ", ".join(own)
    base = max(within, key=lambda k: len(changes[k]))
    return ", ".join([f"as `{base}`", *(change for change in own if change not in changes[base])])
