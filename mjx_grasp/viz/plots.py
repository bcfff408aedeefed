"""Plots of trainings and results, drawn without a display or any global state."""

from __future__ import annotations

import csv
import io
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.conditions import BEGAN_WITH, POLICIES, Column
from mjx_grasp.evaluation.front_tables import Front
from mjx_grasp.evaluation.judging import interval
from mjx_grasp.viz.labels import Label, place

Metrics = dict[str, Float[np.ndarray, " t"]]

_CURVES = (  # column, title, factor
    ("return", "return of finished episodes", 1.0),
    ("success", "success [%]", 100.0),
    ("force_n", "contact force per finger [N]", 1.0),
    ("steps_per_s", "environment steps per second", 1.0),
)
_BLUE, _ORANGE = "#2563a8", "#c8641e"
GREY = "#5b6470"
"""Of words."""
_MARKERS = (("o", _BLUE), ("^", "#7a4fa3"), ("v", "#b03060"), ("P", "#5b6470"))
_LOOKS = {"squeeze": ("s", _ORANGE), "grip": ("D", "#2e8b57"), BEGAN_WITH: ("o", GREY)}
_HELD, _TOLD = POLICIES
_TITLE = 46  # letters in a line above a panel
_ROOM = 0.36, 6.0  # N and % that two points with words need between them
_LEGEND = {
    "squeeze": "squeeze, by the force commanded",
    "grip": "answering grip, by its μ₀",
    _HELD: "policy, held to its budget",
    _TOLD: "policy, told its budget alone",
    BEGAN_WITH: BEGAN_WITH,
}
_BUDGETS = tuple(np.linspace(0.0, 8.0, 81).tolist())  # N
_SMOOTHING = 15  # rows, at most; and never more than a tenth of the curve


def read_metrics(path: str | Path) -> Metrics:
    """Reads a run's metrics.csv; cells that are empty or no numbers become nan.

    Raises:
        FileError: The file is missing, or has no rows or no `env_steps`.
    """
    expected = "a metrics.csv with a column env_steps and at least one row"
    try:
        with Path(path).open(newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, f"an unreadable file ({error})", expected) from None
    if not rows or "env_steps" not in rows[0]:
        raise FileError(path, f"{len(rows)} rows of {list(rows[0]) if rows else []}", expected)
    return {name: np.array([_number(r.get(name)) for r in rows]) for name in rows[0] if name}


def training_curves(metrics: Metrics) -> bytes:
    """Return, success, force and speed against environment steps, as PNG.

    A curve whose column is missing or holds no number says so in its place.
    """
    figure = new_figure(9.6, 5.6)
    axes = figure.subplots(2, 2, sharex=True)
    steps = metrics["env_steps"]
    for ax, (name, title, factor) in zip(axes.flat, _CURVES, strict=True):
        style(ax)
        ax.set_title(title, loc="left", fontsize=10, color=GREY)
        values = factor * metrics.get(name, np.full(len(steps), np.nan))
        known = np.isfinite(values) & np.isfinite(steps)
        if not known.any():
            why = "no whole episode ended" if name in metrics else "not recorded"
            ax.text(0.5, 0.5, why, ha="center", color=GREY, transform=ax.transAxes)
            continue
        x, y = steps[known], values[known]
        ax.plot(x, y, color=_BLUE, alpha=0.25, linewidth=1)
        ax.plot(x, _smooth(y), color=_BLUE, linewidth=1.8, marker="o" if len(y) == 1 else "")
        if name == "success":
            ax.set_ylim(-2, 102)
        else:
            ax.set_ylim(bottom=min(0.0, float(y.min())))
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        if name == "steps_per_s":
            ax.yaxis.set_major_formatter(EngFormatter(sep=""))
    for ax in axes[-1]:
        ax.set_xlabel("environment steps", fontsize=9, color=GREY)
    return png(figure)


def success_against_force(panels: Mapping[str, Sequence[Column]]) -> bytes:
    """Mean success against the mean contact force it took, a panel per condition, as PNG.

    Controllers of one family (squeezes at several forces, grips of several frictions, a policy with
    several budgets) are joined and share a marker, with what each was asked for beside it.
    Controllers without a force are left out.

    Args:
        panels: Controllers by the condition's words.

    Raises:
        InputError: No panel, or one in which no controller has a force.
    """
    if not panels:
        raise InputError("panels", "none", "one condition or more")
    points = {title: _points(columns) for title, columns in panels.items()}
    families = sorted({p.family for part in points.values() for p in part} - _LOOKS.keys())
    looks = _LOOKS | dict(zip(families, itertools.cycle(_MARKERS)))
    lowest = min(p.interval[0] for part in points.values() for p in part)
    figure = new_figure(4.2 * len(panels), 4.2)
    grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    shown = {}
    for ax, (title, part) in zip(grid, points.items(), strict=True):
        style(ax)
        ax.set_ylim(min(80, 20 * (lowest // 20)), 109)  # words stand above the points
        ax.set_xlabel("mean contact force per finger [N]", fontsize=9, color=GREY)
        ax.set_title(fill(title, _TITLE), loc="left", fontsize=10, color=GREY)
        for family in dict.fromkeys(p.family for p in part):
            own = [p for p in part if p.family == family]
            shown[family] = _front(ax, own, *looks[family])
    grid[0].set_xlim(0, 1.25 * max(p.force for part in points.values() for p in part))
    grid[0].set_ylabel("mean success over the objects [%]", fontsize=9, color=GREY)
    names = [name for name in dict.fromkeys((*_LEGEND, *families)) if name in shown]
    figure.legend(
        handles=[shown[name] for name in names],
        labels=[_LEGEND.get(name, name) for name in names],
        loc="outside lower center", ncols=min(4, 2 * len(panels)), frameon=False, fontsize=8,
    )  # fmt: skip
    for ax, part in zip(grid, points.values(), strict=True):
        place(ax, _labels(part, looks))
    return png(figure)


def success_within_budgets(panels: Mapping[str, Front]) -> bytes:
    """Share of trials lifted within a mean force, against it, a panel per condition, as PNG.

    A curve per family of controllers, each at the best of its settings, with the 95 % interval over
    start states.

    Args:
        panels: Controllers from the same starts, by the condition's words.

    Raises:
        InputError: No panel.
    """
    if not panels:
        raise InputError("panels", "none", "one condition or more")
    figure = new_figure(4.2 * len(panels), 4.2)
    grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    families = sorted({name for front in panels.values() for name in front.families})
    looks = _LOOKS | dict(zip([f for f in families if f not in _LOOKS], itertools.cycle(_MARKERS)))
    shown = {}
    for ax, (title, front) in zip(grid, panels.items(), strict=True):
        style(ax)
        ax.set_ylim(0, 103)
        ax.set_xlim(0, _BUDGETS[-1])
        ax.set_xlabel("budget: mean contact force per finger [N]", fontsize=9, color=GREY)
        ax.set_title(fill(title, _TITLE), loc="left", fontsize=10, color=GREY)
        for family in front.families:
            values, (_, colour) = front.within(family, _BUDGETS), looks[family]
            (shown[family],) = ax.plot(_BUDGETS, values[0], color=colour, linewidth=1.8)
            ax.fill_between(_BUDGETS, *interval(values), color=colour, alpha=0.15, linewidth=0)
    grid[0].set_ylabel("lifted within the budget [%]", fontsize=9, color=GREY)
    names = [name for name in families if name in shown]
    policies = {name: _LEGEND[name] for name in POLICIES}
    figure.legend(
        handles=[shown[name] for name in names], labels=[policies.get(n, n) for n in names],
        loc="outside lower center", ncols=min(4, 2 * len(panels) - 1), frameon=False, fontsize=8,
    )  # fmt: skip
    return png(figure)


class _Point(NamedTuple):
    force: float
    mean: float
    interval: tuple[float, float]
    setting: str
    family: str


def _points(columns: Sequence[Column]) -> list[_Point]:
    """The controllers that have a force.

    Raises:
        InputError: There is none.
    """
    points = []
    for column in columns:
        force, _ = column.forces()
        if force is not None:
            family = column.family or column.label
            setting = column.label.removeprefix(family).strip(", ")
            points.append(_Point(force, *column.mean(), setting, family))
    if not points:
        raise InputError("columns", [c.label for c in columns], "a controller with a force")
    return points


def _front(ax: Axes, points: Sequence[_Point], marker: str, colour: str) -> ErrorbarContainer:
    """Controllers of one family, joined. What a training began with is a ring around its policy."""
    points = sorted(points)
    ring = {"markerfacecolor": "none", "markersize": 11, "zorder": 1}
    look = ring if points[0].family == BEGAN_WITH else {"markersize": 6}
    ax.plot([p.force for p in points], [p.mean for p in points], color=colour, alpha=0.5)
    for point in points:
        low, high = point.interval
        dot = ax.errorbar(
            point.force, point.mean, yerr=[[point.mean - low], [high - point.mean]], fmt=marker,
            color=colour, capsize=3, **look,
        )  # fmt: skip
    return dot


def _labels(points: Sequence[_Point], looks: Mapping[str, tuple[str, str]]) -> list[Label]:
    """What the points of families with several were asked for, where they are apart."""
    count, named, labels = Counter(p.family for p in points), dict[str, _Point](), []
    # Beside these, others were asked for the same, in their order.
    beside = (BEGAN_WITH, *((_TOLD,) if _HELD in count else ()))
    for point in sorted(points):
        family, last = point.family, named.get(point.family)
        if count[family] > 1 and family not in beside and (last is None or _apart(last, point)):
            named[family] = point
            text = point.setting.rpartition(", ")[2].removeprefix("budget ")
            labels.append(Label(text, point.force, point.mean, looks[family][1]))
    return labels


def _apart(one: _Point, other: _Point) -> bool:
    """Whether it is plain which of two points words are of."""
    force, success = _ROOM
    return abs(other.force - one.force) > force or abs(other.mean - one.mean) > success


def _smooth(values: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """Centred moving mean, over fewer values towards the ends."""
    half = min(_SMOOTHING, len(values) // 10) // 2
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (total[high] - total[low]) / (high - low)


def _number(cell: str | None) -> float:
    try:
        return float(cell) if cell else float("nan")
    except ValueError:
        return float("nan")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches, on white."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def style(ax: Axes) -> None:
    """Quiet axes: thin and grey, with lines across."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#c4cad2")
    ax.tick_params(colors=GREY, labelsize=8)
    ax.grid(axis="y", color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
