"""How success grew in trainings, over their steps and over time: a record and a picture.

  python experiments/learning_curves.py runs/A runs/B --handoffs report.json

adds the runs to the record; a run that is there already is replaced, and the picture shows all.
Without runs it only draws. Success is that of the training's own episodes, with exploration noise;
those of an end-to-end training begin on the way home, up to the level of its curriculum.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator
from success_curves import COLOURS

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.records.atomic import read_json, replacing, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.tasks.config import EndToEndConfig
from mjx_grasp.training.config import TrainConfig, settings_of, stored_config
from mjx_grasp.viz.plots import GREY, Metrics, new_figure, png, read_metrics, style

ROOT = Path(__file__).resolve().parent.parent
SCHEMA = "mjx_grasp.learning_curves/1"
POINTS = 60
"""Of a run, at most."""
_EPISODES = 100  # of a point, at least
_COLOURS = {
    "closing": (COLOURS[0], "#3f8fd2", "#12365c", "#159a9c"),
    "end_to_end": (
        *(COLOURS[1], "#6e2f05", "#cf8a00", "#a3195b", "#7a5ba8", "#8c8c8c", "#2f7d4f"),
        *("#e0709f", "#5c6b1f", "#c2410c"),
    ),
}
_APART = 7.0  # of two words, at least [% of success]
_MILLIONS = (1, 3, 10, 30, 100, 300, 1000)
_MINUTES = (1, 2, 5, 10, 20, 60, 180, 600)


@dataclass(frozen=True)
class CurvesConfig(CommandSettings):
    """Which runs to add, and where record and picture are."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """folders of runs"""
    handoffs: tuple[Path, ...] = ()
    """reports of start states: what they took is charged to the runs that began from them"""
    results: Path = ROOT / "experiments" / "results" / "learning_curves.json"
    out: Path = ROOT / "docs" / "learning_curves.png"


def curve(folder: Path, reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The record of a run.

    Args:
        folder: Of the run.
        reports: Of start states.

    Raises:
        FileError: The folder lacks a run's files, or too few whole episodes ended in it.
    """
    config, metrics = stored_config(folder), read_metrics(folder / "metrics.csv")
    end_to_end = isinstance(config.task, EndToEndConfig)
    points = list(_points(metrics))
    if not points:
        raise FileError(folder / "metrics.csv", "too few whole episodes", f"{_EPISODES} and more")
    steps, seconds, success, level = (list(part) for part in zip(*points, strict=True))
    return {
        "task": "end_to_end" if end_to_end else "closing",
        "words": _words(config),
        "handoff_seconds": _handoff_seconds(config, reports),
        "env_steps": steps,
        "seconds": seconds,
        "success_percent": success,
        "level": level if end_to_end else None,
        "provenance": read_json(folder / "provenance.json", "the provenance of a run"),
    }


def _points(metrics: Metrics) -> Iterator[tuple[int, float, float, float]]:
    """Steps, seconds and level at the end of some iterations, success of the episodes in them."""
    rows = len(metrics["env_steps"])
    for part in np.array_split(np.arange(rows), min(POINTS, rows)):
        episodes = np.nan_to_num(metrics["episodes"][part])
        if episodes.sum() < _EPISODES:
            continue
        success = 100 * np.average(np.nan_to_num(metrics["success"][part]), weights=episodes)
        end = part[-1]
        level = metrics["reach_level"][end] if "reach_level" in metrics else 1.0
        yield (
            int(metrics["env_steps"][end]),
            round(float(metrics["seconds"][end]), 1),
            round(float(success), 2),
            round(float(level), 3),
        )


def _words(config: TrainConfig) -> str:
    """What a run learnt, and from what."""
    task, number = config.task, len(resolve(config.objects))
    way, preset = "by parts", "paper"
    if isinstance(task, EndToEndConfig):
        way, preset = "end to end", "end-to-end"
    how = ", as published" if task == settings_of(preset).task else ""
    if isinstance(task, EndToEndConfig) and not how:
        how += ", assisted" if task.assisted else ""
        how += f", arm {task.reach_rate:g} rad/s" if task.reach_rate is not None else ""
        how += "" if task.raised else ", straight way"
        how += "" if task.action.others else ", closing's joints"
    return f"{way}{how}, {number} object{'s' * (number != 1)}"


def _handoff_seconds(config: TrainConfig, reports: Sequence[dict[str, Any]]) -> float | None:
    """What the start states of the run's objects took [s]; None where no report is about them."""
    for report in reports:
        if config.handoffs is None or Path(report["config"]["out"]) != config.handoffs:
            continue
        took = {row["name"]: row["seconds"] for row in report["objects"]}
        asked = resolve(config.objects)
        if took.keys() >= set(asked):
            return round(sum(took[name] for name in asked), 1)
    return None


def draw(runs: dict[str, dict[str, Any]]) -> bytes:
    """Success over steps and over time, as PNG.

    What was learnt by parts is charged for making its start states, where that is known; an
    end-to-end training is not.
    """
    figure = new_figure(10.6, 4.4)
    over_steps, over_time = figure.subplots(1, 2, sharey=True)
    colours = {task: iter(shades * len(runs)) for task, shades in _COLOURS.items()}
    ends: list[tuple[float, float, str, str]] = []
    begins = np.inf
    for name, run in runs.items():
        colour, success = next(colours[run["task"]]), np.array(run["success_percent"])
        whole = np.array(run["level"] or [1.0] * len(success)) >= 1.0
        seconds, words = np.array(run["seconds"]), run["words"]
        if run["task"] == "closing":
            seconds = seconds + (run["handoff_seconds"] or 0.0)
            known = run["handoff_seconds"] is not None
            words += "" if known else ",\nstart states not counted"
        steps = 1e-6 * np.array(run["env_steps"])
        _line(over_steps, steps, success, whole, colour)
        _line(over_time, seconds / 60, success, whole, colour)
        begins = min(begins, float(seconds[0]) / 60)
        ends.append((float(seconds[-1]) / 60, float(success[-1]), colour, f"{name}: {words}"))
    minutes = "minutes, with compilation and the making of start states"
    for ax, label in ((over_steps, "million environment steps"), (over_time, minutes)):
        style(ax)
        ax.set_xlabel(label, fontsize=9, color=GREY)
        ax.set_ylim(0, 100)
    over_steps.set_xscale("log")
    over_steps.set_xticks(_MILLIONS, map(str, _MILLIONS))
    over_steps.xaxis.set_minor_locator(NullLocator())
    over_steps.text(
        0.0, 1.02, "dashed: end-to-end episodes begin on a part of the way only",
        transform=over_steps.transAxes, va="bottom", fontsize=8, color=GREY,
    )  # fmt: skip
    over_steps.set_ylabel("success of the training's episodes [%]", fontsize=9, color=GREY)
    over_time.set_xscale("log")
    over_time.set_xticks(_MINUTES, map(str, _MINUTES))
    over_time.xaxis.set_minor_locator(NullLocator())
    over_time.set_xlim(0.85 * begins, 1.15 * max(end[0] for end in ends))
    _label(over_time, ends)
    return png(figure)


def _line(
    ax: Axes,
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
    whole: Bool[np.ndarray, " n"],
    colour: str,
) -> None:
    """A curve, thin and dashed while episodes do not begin on the whole way yet."""
    split = int(np.argmax(whole)) if whole.any() else len(whole)
    dashes = {"linewidth": 1.0, "linestyle": (0, (3, 1.5)), "alpha": 0.6}
    ax.plot(x[: split + 1], y[: split + 1], color=colour, **dashes)
    ax.plot(x[split:], y[split:], color=colour, linewidth=1.8)


def _label(ax: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Words to the right of where curves end, near their height and apart from each other."""
    ends = sorted(ends, key=lambda end: end[1])
    for (x, y, colour, words), at in zip(ends, heights([y for _, y, *_ in ends]), strict=True):
        ax.annotate(
            words, (x, y), xytext=(1.03, at / 100), textcoords="axes fraction", color=colour,
            fontsize=8, va="center", annotation_clip=False,
            arrowprops={
                **{"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.6},
                "relpos": (0, 0.5),
            },
        )  # fmt: skip


def heights(wanted: Sequence[float]) -> Float[np.ndarray, " n"]:
    """Heights of words that are as wanted, or moved up, or down from the top, to be apart.

    Args:
        wanted: From the lowest up [% of success].
    """
    at, step = np.array(wanted, float), _APART * np.arange(len(wanted))
    at = np.maximum.accumulate(at - step) + step
    return np.minimum(at, 100.0 - step[::-1])


def main(config: CurvesConfig) -> None:
    """Adds the runs and draws all."""
    runs: dict[str, dict[str, Any]] = {}
    if config.results.exists():
        runs = read_json(config.results, "a record of learning curves")["runs"]
    reports = [read_json(path, "a report of start states") for path in config.handoffs]
    if config.runs:
        runs |= {folder.name: curve(folder, reports) for folder in config.runs}
        content = {"schema": SCHEMA, "runs": runs, "provenance": provenance(seed=0)}
        write_json(config.results, content)
    if not runs:
        raise FileError(config.results, "no run", "a record, or folders of runs")
    with replacing(config.out) as temporary:
        temporary.write_bytes(draw(runs))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(CurvesConfig, description=__doc__)))
