"""Plots of trainings and results, drawn without a display or any global state."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.results import ResultRow, mean_success
from mjx_grasp.evaluation.tables import Column

Metrics = dict[str, Float[np.ndarray, " t"]]

_CURVES = (  # column, title, factor
    ("return", "return of finished episodes", 1.0),
    ("success", "success [%]", 100.0),
    ("force_n", "contact force per finger [N]", 1.0),
    ("steps_per_s", "environment steps per second", 1.0),
)
_BLUE, _ORANGE, _GREY = "#2563a8", "#c8641e", "#5b6470"
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
    figure = _figure(9.6, 5.6)
    axes = figure.subplots(2, 2, sharex=True)
    steps = metrics["env_steps"]
    for ax, (name, title, factor) in zip(axes.flat, _CURVES, strict=True):
        _style(ax)
        ax.set_title(title, loc="left", fontsize=10, color=_GREY)
        values = factor * metrics.get(name, np.full(len(steps), np.nan))
        known = np.isfinite(values) & np.isfinite(steps)
        if not known.any():
            ax.text(0.5, 0.5, "not recorded", ha="center", color=_GREY, transform=ax.transAxes)
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
        ax.set_xlabel("environment steps", fontsize=9, color=_GREY)
    return _png(figure)


def success_against_force(columns: Sequence[Column]) -> bytes:
    """Mean success against the mean contact force it took, one point per controller, as PNG.

    Squeezes at several forces are joined to a front.

    Raises:
        InputError: No controller has a force.
    """
    points = [p for p in map(_point, columns) if p is not None]
    if not points:
        raise InputError("columns", [c.label for c in columns], "a controller with a force")
    figure = _figure(6.0, 4.0)
    ax = figure.subplots()
    _style(ax)
    squeezes = sorted(p for p in points if p[4])
    ax.plot([p[0] for p in squeezes], [p[1] for p in squeezes], color=_ORANGE, alpha=0.5)
    for force, mean, (low, high), label, is_squeeze in points:
        colour = _ORANGE if is_squeeze else _BLUE
        ax.errorbar(
            force, mean, yerr=[[mean - low], [high - mean]], fmt="s" if is_squeeze else "o",
            color=colour, capsize=3, markersize=7 if is_squeeze else 9,
        )  # fmt: skip
        ax.annotate(label, (force, mean), xytext=(8, -12), textcoords="offset points", color=colour)
    ax.set_xlim(0, 1.25 * max(p[0] for p in points))
    ax.set_ylim(0, 103)
    ax.set_xlabel("mean contact force per finger [N]", fontsize=9, color=_GREY)
    ax.set_title("mean success over the objects [%]", loc="left", fontsize=10, color=_GREY)
    return _png(figure)


def _point(column: Column) -> tuple[float, float, tuple[float, float], str, bool] | None:
    rows: list[ResultRow] = list(column.rows.values())
    force, _ = column.forces()
    if force is None:
        return None
    mean, interval = mean_success(rows)
    return force, mean, interval, column.label, rows[0].squeeze_force_n is not None


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


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _style(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#c4cad2")
    ax.tick_params(colors=_GREY, labelsize=8)
    ax.grid(axis="y", color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
