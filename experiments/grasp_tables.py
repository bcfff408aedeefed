"""Tables for the READMEs: whole grasps, object by object and scenario by scenario.

Each takes the path of a results file, or several, and gives Markdown; `make_readme.py` puts it in
place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markdown_tables import NOTHING, markdown, read

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.blocks import blocks_of
from mjx_grasp.evaluation.grasps.scenario import NOMINAL
from mjx_grasp.evaluation.statistics import bootstrap_mean_interval
from mjx_grasp.objects.catalogue import find_objects, groups
from mjx_grasp.pipeline.phases import Failure
from mjx_grasp.records.table import Table

_NO_WAY = Failure.NO_CANDIDATE.name.lower()
_ENGINES = {"mujoco": "native MuJoCo", "mjx": "MJX (MuJoCo Warp)"}
_SHORT = {"mujoco": "native", "mjx": "MJX"}
_GRASP_COLUMNS = (
    *("trials", "lifted and held %", "at once %", "up after 9 s %"),
    *("lifted s", "force N"),
)


def route(path: Path) -> str:
    """What came of the poses that were tried for the picture of the route."""
    d = read(path)
    if d is None:
        return NOTHING
    name, tried = d["object"].replace("_", " "), len(d["outcomes"])
    return (
        f"{name} ({d['mesh']}), {d['asked']}, scenario {d['scenario']['name']}: the first success "
        f"in {tried} random pose{'s' * (tried > 1)} (seed {d['seed']})."
    )


def whole_grasps(path: Path) -> str:
    """Grasps from home while nothing happens, object by object."""
    record = read(path)
    if record is None:
        return NOTHING
    nominal = record["scenarios"][NOMINAL]
    lines = []
    for name, s in {**nominal["objects"], "all": nominal["all"]}.items():
        tips = " / ".join(_number(x) for x in s["tip_error_mm"])
        rows = [row for row in nominal["rows"] if name in (row["object"], "all")]
        lines.append((name.replace("_", " "), *_grasp_cells(s, rows), *_failure_cells(s), tips))
    header = (
        *("object", *_GRASP_COLUMNS),
        *("not reached", "lost", "tips mm"),
    )
    return _closed_by(record) + markdown(Table("Whole grasps", header, tuple(lines), summary=1))


def grasps_in_short(scenarios: Path, every: Path) -> str:
    """Grasps from home: of the eight with and without what may happen, and of all objects.

    Args:
        scenarios: Of the eight objects.
        every: Of all objects, while nothing happens.
    """
    eight, objects = read(scenarios), read(every)
    if eight is None or objects is None:
        return NOTHING
    found = {name: result["rows"] for name, result in eight["scenarios"].items()}
    lines = [("the eight", *_short_cells(found.pop(NOMINAL)))]
    if found:
        worst = min(found, key=lambda name: len(_held(found[name])) / len(found[name]))
        happens = eight["scenarios"][worst]["settings"]["description"]
        together = [row for rows in found.values() for row in rows]
        lines += [
            (f"{len(found)} scenarios together", *_short_cells(together)),
            (f"the hardest of these: {happens}", *_short_cells(found[worst])),
        ]
    names, rows = objects["scenarios"][NOMINAL]["objects"], objects["scenarios"][NOMINAL]["rows"]
    for split, said in (("train", "objects of training"), ("held_out", "objects kept out of it")):
        own = [name for name in names if name in groups()[split]]
        if own:
            of = [row for row in rows if row["object"] in own]
            lines.append((f"{len(own)} {said}", *_short_cells(of)))
    header = ("from home", "trials", "lifted and held %", "at once %", "lifted after s")
    return markdown(Table("Whole grasps", (*header, "contact force N"), tuple(lines)))


def _short_cells(rows: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    held = _held(rows)
    means = (_number(_mean(row[of] for row in held)) for of in ("lifted_s", "force_mean_n"))
    return str(len(rows)), f"{100.0 * len(held) / len(rows):.1f}", _at_once(rows), *means


def _at_once(rows: Sequence[dict[str, Any]]) -> str:
    """Of all trials, in %, those that lift and hold and never went back to reaching."""
    return f"{100.0 * sum(not row['returns'] for row in _held(rows)) / len(rows):.1f}"


def _held(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["outcome"] == "success"]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def grasps_by_split(path: Path) -> str:
    """Grasps from home of all objects, with sums over those of training and those kept out.

    Where the controller finds no way to an object it says so; these trials are told apart.
    """
    d = read(path)
    if d is None:
        return NOTHING
    nominal, lines = d["scenarios"][NOMINAL], []
    for split, said in (("train", "Objects of training"), ("held_out", "Objects kept out of it")):
        rows = [row for row in nominal["rows"] if row["object"] in groups()[split]]
        ways = [row for row in rows if not _refused(row)]
        held = [row for row in rows if row["outcome"] == "success"]
        up = [row for row in rows if row["up_at_9s"]]
        lines.append(
            f"- {said}: {_share(held, rows)} lifted and held, {_share(up, rows)} up after 9 s; of "
            f"the {len(ways)} trials of {len(rows)} in which there was a way, {_share(held, ways)} "
            f"and {_share(up, ways)}."
        )
    refused = Counter(row["object"] for row in nominal["rows"] if _refused(row))
    names = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in refused.most_common())
    lines.append(f"- Trials without a way: {names or 'none'}.")
    return f"{whole_grasps(path)}\n\n" + "\n".join(lines)


def _refused(row: dict[str, Any]) -> bool:
    """Whether a trial ended for want of a way; one lost after the lift may find none either."""
    return row["outcome"] == "not_reached" and row["failure"] == _NO_WAY


def _share(some: Sequence[Any], every: Sequence[Any]) -> str:
    return f"{100.0 * len(some) / len(every):.1f} %" if every else "none"


def _closed_by(record: dict[str, Any]) -> str:
    """What closed the grasps of a file, and what simulated them."""
    config, within = record["config"], _ENGINES[_engine(record)]
    if config["controller"] == "grip":
        return f"Closed by the untrained grip alone, in {within}:\n\n"
    budget = f"with a force budget of {config['force_budget']:g} N"
    return f"Closed by the policy, {budget}, in {within}:\n\n"


def _engine(record: dict[str, Any]) -> str:
    """What simulated the grasps of a file; older ones do not say."""
    engine: str = record["config"].get("engine", "mujoco")
    return engine


def scenarios(path: Path) -> str:
    """Grasps from home while this or that happens, over all objects."""
    record = read(path)
    if record is None:
        return NOTHING
    lines = []
    for name, result in record["scenarios"].items():
        s = result["all"]
        what = f"{name.replace('_', ' ')}: {result['settings']['description']}"
        cells = _grasp_cells(s, result["rows"])
        lines.append((what, *cells, *_failure_cells(s), str(s["hit"])))
    header = ("scenario", *_GRASP_COLUMNS, "not reached", "lost", "hit")
    return _closed_by(record) + markdown(Table("Scenarios", header, tuple(lines)))


def scenarios_by_engine(one: Path, other: Path) -> str:
    """The same trials of whole grasps on two engines: scenarios and trials that both files have.

    Raises:
        FileError: They are of one engine, or not the same trials.
    """
    first, second = read(one), read(other)
    if first is None or second is None:
        return NOTHING
    engines = _engine(first), _engine(second)
    if engines[0] == engines[1]:
        raise FileError(other, engines[1], f"another engine than that of {one}")
    for name in ("objects", "seed", "force_budget", "controller"):
        found, expected = second["config"][name], first["config"][name]
        if found != expected:
            raise FileError(other, f"{name} {found!r}", f"{expected!r}, as in {one}")
    if not _first_of_the_other(first["config"], second["config"]):
        found, expected = second["config"]["episodes"], first["config"]["episodes"]
        raise FileError(other, f"episodes {found}", f"{expected}, as in {one}, or whole blocks")
    names = [name for name in first["scenarios"] if name in second["scenarios"]]
    if first["sha256"] != second["sha256"]:
        raise FileError(other, "another policy", f"that of {one}")
    for name in names:
        for what in ("settings", "meshes"):
            if first["scenarios"][name][what] != second["scenarios"][name][what]:
                raise FileError(other, f"{name} of other {what}", f"those of {one}")
    each = {n: [record["scenarios"][n]["rows"] for record in (first, second)] for n in names}
    rows = {n: [own[: min(map(len, of))] for own in of] for n, of in each.items()}
    every = [[row for n in names for row in rows[n][k]] for k in (0, 1)]
    lines = [(name.replace("_", " "), *_compared(*rows[name])) for name in names]
    held, times, forces = (
        [f"{what}, {_SHORT[engine]}" for engine in engines]
        for what in ("lifted and held %", "lifted s", "force N")
    )
    header = ("scenario", "trials", *held, "points", "same outcome %", *times, *forces)
    lines.append(("all", *_compared(*every)))
    return markdown(Table("Scenarios by engine", header, tuple(lines), summary=1))


def _first_of_the_other(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether one of two runs of the same objects and seed has the first trials of the other's."""
    objects = len(find_objects(one["objects"]))
    runs = [blocks_of(config["episodes"], objects, config["seed"]) for config in (one, other)]
    few, many = sorted(runs, key=len)
    return many[: len(few)] == few


def _compared(first: Sequence[dict[str, Any]], second: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Cells of the same trials of two engines."""
    of_each = [np.array([row["outcome"] for row in rows]) for rows in (first, second)]
    held, other = (100.0 * (outcomes == "success") for outcomes in of_each)
    change = f"{(other - held).mean():+.1f}"
    if (held != other).any():
        low, high = bootstrap_mean_interval(other - held, seed=0)
        change += f" ({low:+.1f} to {high:+.1f})"
    means = (
        _number(_mean(row[of] for row in _held(rows)))
        for of in ("lifted_s", "force_mean_n")
        for rows in (first, second)
    )
    same = f"{100.0 * (of_each[0] == of_each[1]).mean():.1f}"
    return str(len(first)), f"{held.mean():.1f}", f"{other.mean():.1f}", change, same, *means


def foreign_meshes(path: Path) -> str:
    """What came of meshes that no catalogue has."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = tuple(
        (name, row["refused"] or f"{row['outcome'].replace('_', ' ')}, "
         + (f"lifted after {row['lifted_s']:.1f} s" if row["lifted_s"] else "not lifted"))
        for name, row in d["meshes"].items()
    )  # fmt: skip
    return markdown(Table("Foreign meshes", ("mesh", "what came of it"), rows, names=2))


def _grasp_cells(s: dict[str, Any], rows: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    return (
        str(s["trials"]),
        f"{s['success_percent']:.1f} ({s['ci95'][0]:.0f}–{s['ci95'][1]:.0f})",
        _at_once(rows),
        f"{100 * s['up_at_9s'] / s['trials']:.1f}",
        _number(s["lifted_s"]),
        _number(s["force_mean_n"]),
    )


def _failure_cells(s: dict[str, Any]) -> tuple[str, str]:
    return str(s["not_reached"]), str(s["never_lifted"] + s["slipped"] + s["not_held"])


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
