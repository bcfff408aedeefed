"""Results files as tables, in Markdown for the READMEs and in HTML for the report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import (
    MESHES,
    Column,
    Condition,
    Groups,
    column_order,
    columns_of,
)
from mjx_grasp.evaluation.results import ResultRow
from mjx_grasp.records.table import Table


def success_table(rows: Sequence[ResultRow], *, scans: bool | None = None) -> Table:
    """The table of `condition_table` from the rows of one run.

    Args:
        rows: Of one condition.
        scans: Whether the objects are real scans; the title does not say if None.

    Raises:
        InputError: The rows are of several conditions, or repeat an outcome.
    """
    groups: Groups = {}
    meshes = "" if scans is None else MESHES[scans]
    for condition, column in columns_of(rows, meshes=meshes):
        groups.setdefault(condition, []).append(column)
    if len(groups) != 1:
        raise InputError("rows", f"{len(groups)} conditions", "rows of one condition")
    ((condition, columns),) = groups.items()
    return condition_table(condition, sorted(columns, key=column_order))


def condition_table(condition: Condition, columns: Sequence[Column]) -> Table:
    """Success per object with 95 % intervals, one column per controller; means and forces below.

    The publication's figures stand beside them, where it has any.

    Args:
        condition: What the columns share.
        columns: The controllers.
    """
    names = _object_order(condition.objects)
    with_paper = bool(condition.objects & paper.OBJECTS.keys())
    header = ["object", *(c.label for c in columns)]
    if with_paper:
        header += ["paper: policy", "paper: squeeze 3 N"]
    rows = []
    for name in names:
        cells = [_rate(c.rows[name].success_percent, c.rows[name].ci95) for c in columns]
        rows.append((_title(name), *cells, *_paper_cells(name, with_paper)))
    complete = condition.objects == paper.OBJECTS.keys()
    means = [f"{m:.1f}" for m in paper.MEAN[:2]] if complete else ["", ""]
    rows.append(("mean %", *(_rate(*c.mean()) for c in columns), *(means if with_paper else [])))
    rows.append(
        (
            "force mean / peak N",
            *(_forces(*c.forces()) for c in columns),
            *(["", ""] if with_paper else []),
        )
    )
    return Table(_title_of(condition, columns), tuple(header), tuple(rows), summary=2)


def force_table(condition: Condition, columns: Sequence[Column]) -> Table:
    """Mean and peak contact force per object and controller [N]."""
    rows = [
        (
            _title(name),
            *(_forces(c.rows[name].force_mean_n, c.rows[name].force_peak_n) for c in columns),
        )
        for name in _object_order(condition.objects)
    ]
    return Table(
        f"Contact force per finger, mean / peak N: {_title_of(condition, columns)}",
        ("object", *(c.label for c in columns)),
        tuple(rows),
    )


def failure_table(condition: Condition, columns: Sequence[Column]) -> Table:
    """Share of each failure class in all episodes [%], beside the publication's."""
    header = ("failure %", *(c.label for c in columns), "paper: policy", "paper: squeeze 3 N")
    rows = []
    for name in ("never_lifted", "not_held", "slipped"):
        cells = []
        for column in columns:
            episodes = sum(r.episodes for r in column.rows.values())
            count = sum(getattr(r, name) for r in column.rows.values())
            cells.append(f"{100 * count / episodes:.1f}")
        of_paper = [f"{paper.FAILURES[who][name]:.1f}" for who in ("ours", "squeeze")]
        rows.append((name.replace("_", " "), *cells, *of_paper))
    return Table(f"Failures: {_title_of(condition, columns)}", header, tuple(rows))


def _object_order(objects: Iterable[str]) -> list[str]:
    order = {name: i for i, name in enumerate(paper.OBJECTS)}
    return sorted(objects, key=lambda name: (order.get(name, len(order)), name))


def _title_of(condition: Condition, columns: Sequence[Column]) -> str:
    episodes = sorted({r.episodes for c in columns for r in c.rows.values()})
    count = f"{episodes[0]}" if len(episodes) == 1 else f"{episodes[0]}–{episodes[-1]}"
    return f"{condition.text()}, {count} episodes per object"


def _paper_cells(name: str, with_paper: bool) -> list[str]:
    if not with_paper:
        return []
    row = paper.OBJECTS.get(name)
    return [f"{row.ours:.1f}", f"{row.squeeze:.1f}"] if row else ["", ""]


def _title(name: str) -> str:
    return name.replace("_", " ")


def _rate(percent: float, interval: tuple[float, float]) -> str:
    return f"{percent:.1f} ({interval[0]:.0f}–{interval[1]:.0f})"


def _force(newton: float | None) -> str:
    return "" if newton is None else f"{newton:.1f}"


def _forces(mean: float | None, peak: float | None) -> str:
    return "" if mean is None or peak is None else f"{_force(mean)} / {_force(peak)}"


def untrained_note(force: float) -> str:
    """What a squeeze with the policy's own command is.

    Args:
        force: Of the command, per finger [N].
    """
    return f"squeeze {force:g} N is the policy before its training: the command that it adds to."
