"""The report of a run: one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.conditions import Groups, read_groups
from mjx_grasp.evaluation.front_tables import (
    budget_table,
    equal_force_table,
    front_panels,
)
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.tables import condition_table, failure_table, force_table, untrained_note
from mjx_grasp.evaluation.verdict import result_table, verdict
from mjx_grasp.records.atomic import read_json, replacing
from mjx_grasp.viz.plots import (
    read_metrics,
    success_against_force,
    success_within_budgets,
    training_curves,
)
from mjx_grasp.viz.rendering import RenderError, VideoConfig, render_in_subprocess


def write_report(
    run_dir: str | Path,
    results_paths: Sequence[str | Path],
    video_path: str | Path | None,
    video_problem: str | None,
    out_html: str | Path,
) -> None:
    """Writes the report of a run.

    What the run lacks is named in its place; only results files that are given must be readable.

    Args:
        run_dir: The run's folder: metrics.csv, config.json, provenance.json.
        results_paths: Results files of its evaluation.
        video_path: A rendered grasp (.mp4 or .gif), or None.
        video_problem: Why there is no video and how to get one; shown in its place.
        out_html: The report.

    Raises:
        FileError: A results file cannot be read.
    """
    run = Path(run_dir)
    provenance = _stored(run / "provenance.json")
    if provenance is None and results_paths:
        provenance = read_results(results_paths[0]).provenance
    groups = read_groups(results_paths)
    sections = [
        _result(groups, results_paths),
        _side_by_side(_front(groups), _video(video_path, video_problem)),
        _section("Training", _curves(run / "metrics.csv")),
        _section("Success in detail", _results(groups)) if groups else "",
        _section(
            "How it was made",
            _facts(_stored(run / "config.json"), "config.json")
            + _facts(provenance, "provenance.json"),
        ),
    ]
    style = asset_path("report.css").read_text()
    page = (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width,initial-scale=1'>"
        f"<title>mjx_grasp: {html.escape(run.name)}</title><style>{style}</style></head>"
        f"<body><main class='run'><h1>Training {html.escape(run.name)}</h1>"
        f"<p class='lead'>{html.escape(_lead(provenance))}</p>{''.join(sections)}"
        "</main></body></html>\n"
    )
    with replacing(out_html) as temporary:
        temporary.write_text(page, encoding="utf-8")


def report_run(folder: Path, console: Console) -> Path:
    """Renders the recorded grasp of a run that has been evaluated, and writes its `report.html`.

    Args:
        folder: The run, with `grasp.npz` and `results.json`.
        console: Where the report is named.
    """
    video, problem = folder / "grasp.mp4", None
    try:
        render_in_subprocess(VideoConfig(folder / "grasp.npz", out=video))
    except RenderError as error:
        problem = str(error)
    out = folder / "report.html"
    write_report(folder, [folder / "results.json"], None if problem else video, problem, out)
    console.print(f"report: {out}")
    return out


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"


def _lead(provenance: dict[str, Any] | None) -> str:
    if provenance is None:
        return ""
    return f"{provenance.get('command', '')}, on {provenance.get('device', 'an unknown device')}"


def _video(path: str | Path | None, problem: str | None) -> str:
    if path is None:
        return _note(f"No video. {problem or 'None was rendered.'}")
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        return _note(f"No video: {path}: {error.strerror}.")
    if Path(path).suffix == ".gif":
        return _image(data, "a grasp", "image/gif")
    source = f"data:video/mp4;base64,{base64.b64encode(data).decode()}"
    video = f"<video src='{source}' controls autoplay loop muted playsinline></video>"
    return video + _caption("A grasp of the trained policy.")


def _result(groups: Groups, paths: Sequence[str | Path]) -> str:
    """What came of it, in a sentence and a small table."""
    if not paths:
        return _note("No evaluation in this run: python -m mjx_grasp.evaluate makes one.")
    sentences = (each.replace(" %", "\N{NO-BREAK SPACE}%") for each in verdict(groups))
    said = "".join(f"<p class='verdict'>{html.escape(each)}</p>" for each in sentences)
    table = result_table(groups)
    extras = [read_results(path).extra for path in paths]
    untrained = {float(e["untrained_n"]) for e in extras if "untrained_n" in e}
    notes = "".join(_note(untrained_note(force)) for force in untrained)
    return f"<section class='result'>{said}{table.html() if table.rows else ''}{notes}</section>"


def _front(groups: Groups) -> str:
    """Success against force as a picture, where forces were kept."""
    panels = {
        condition.short() if len(groups) > 1 else "": columns
        for condition, columns in groups.items()
        if any(force is not None for c in columns for force in c.forces())
    }
    if not panels:
        return ""
    picture = _image(success_against_force(panels), "mean success against mean contact force")
    return picture + _caption("Success against force, a point per setting: up and left is better.")


def _side_by_side(*parts: str) -> str:
    return f"<div class='beside'>{''.join(f'<div>{part}</div>' for part in parts if part)}</div>"


def _results(groups: Groups) -> str:
    tables = (make(groups).condensed() for make in (equal_force_table, budget_table))
    parts = [condition_table(*group).narrow().html() for group in groups.items()]
    detail = [table.html() for table in tables if table.rows]
    if panels := front_panels(groups):
        detail.append(_image(success_within_budgets(panels), "success within a force budget"))
    for group in groups.items():
        detail += [make(*group).narrow().html() for make in (force_table, failure_table)]
    return "".join(parts) + _details("budgets, forces and failures", "".join(detail))


def _curves(path: Path) -> str:
    try:
        curves = _image(training_curves(read_metrics(path)), "training curves")
    except FileError as error:
        return _note(f"No curves: {error}.")
    return f"<div class='curves'>{curves}</div>"


def _facts(values: dict[str, Any] | None, name: str) -> str:
    if values is None:
        return _note(f"The run has no readable {name}.")
    return _details(name, f"<pre>{html.escape(json.dumps(values, indent=2))}</pre>")


def _details(title: str, body: str) -> str:
    return f"<details><summary>{title}</summary>{body}</details>"


def _stored(path: Path) -> dict[str, Any] | None:
    try:
        return read_json(path, "facts of the run")
    except FileError:
        return None


def _image(data: bytes, alt: str, kind: str = "image/png") -> str:
    return f"<img alt='{alt}' src='data:{kind};base64,{base64.b64encode(data).decode()}'>"


def _caption(text: str) -> str:
    return f"<p class='lead'>{text}</p>"


def _note(text: str) -> str:
    return f"<p class='note'>{html.escape(text)}</p>"
