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
from mjx_grasp.evaluation.front_tables import (
    budget_table,
    equal_force_table,
    front_panels,
    headline,
)
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.tables import (
    Groups,
    condition_table,
    failure_table,
    force_table,
    read_groups,
    untrained_note,
)
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
        *([_section("Result", first)] if (first := _headline(groups)) else []),
        _section("A grasp", _video(video_path, video_problem)),
        _section("Success", _results(groups, results_paths)),
        _section("Training", _curves(run / "metrics.csv")),
        _section("Configuration", _facts(_stored(run / "config.json"), "config.json")),
        _section("Provenance", _facts(provenance, "provenance.json")),
    ]
    style = asset_path("report.css").read_text()
    page = (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'>"
        f"<title>mjx_grasp: {html.escape(run.name)}</title><style>{style}</style></head>"
        f"<body><main><h1>Training {html.escape(run.name)}</h1>"
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
    return f"<video src='{source}' controls autoplay loop muted playsinline></video>"


def _headline(groups: Groups) -> str:
    """What came of it in a few sentences, and as a picture where forces were kept."""
    said = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in headline(groups))
    panels = {
        condition.short(): columns
        for condition, columns in groups.items()
        if any(force is not None for c in columns for force in c.forces())
    }
    picture = success_against_force(panels) if panels else None
    return said + (_image(picture, "mean success against mean contact force") if picture else "")


def _results(groups: Groups, paths: Sequence[str | Path]) -> str:
    if not paths:
        return _note("No evaluation in this run: python -m mjx_grasp.evaluate makes one.")
    tables = (make(groups) for make in (equal_force_table, budget_table))
    parts = [table.html() for table in tables if table.rows]
    if panels := front_panels(groups):
        parts.append(_image(success_within_budgets(panels), "success within a force budget"))
    for condition, columns in groups.items():
        parts.append(condition_table(condition, columns).html())
        detail = force_table(condition, columns).html() + failure_table(condition, columns).html()
        parts.append(f"<details><summary>forces and failures</summary>{detail}</details>")
    extras = [read_results(path).extra for path in paths]
    untrained = {float(e["untrained_n"]) for e in extras if "untrained_n" in e}
    return "".join([*parts, *(_note(untrained_note(force)) for force in untrained)])


def _curves(path: Path) -> str:
    try:
        return _image(training_curves(read_metrics(path)), "training curves")
    except FileError as error:
        return _note(f"No curves: {error}.")


def _facts(values: dict[str, Any] | None, name: str) -> str:
    if values is None:
        return _note(f"The run has no readable {name}.")
    return f"<pre>{html.escape(json.dumps(values, indent=2))}</pre>"


def _stored(path: Path) -> dict[str, Any] | None:
    try:
        return read_json(path, "facts of the run")
    except FileError:
        return None


def _image(data: bytes, alt: str, kind: str = "image/png") -> str:
    return f"<img alt='{alt}' src='data:{kind};base64,{base64.b64encode(data).decode()}'>"


def _note(text: str) -> str:
    return f"<p class='note'>{html.escape(text)}</p>"
