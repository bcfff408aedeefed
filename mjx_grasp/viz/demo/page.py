"""The page of a demo: one HTML file that needs nothing beside it, made for small screens too."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from mjx_grasp.assets import asset_path
from mjx_grasp.viz.demo.plots import Curves, Stage, grasp_plot, stage_plot
from mjx_grasp.viz.heatmap import Subject, draw

_PIXELS = 640
_PHONE = (
    "main{max-width:44rem}video,img{width:100%;height:auto;display:block}"
    "dl{display:grid;grid-template-columns:auto 1fr;gap:.2rem 1rem;margin:.6rem 0}"
    "dt{color:#5b6470}dd{margin:0;font-variant-numeric:tabular-nums}"
    ".verdict{font-weight:600}.held{color:#1d7a43}.failed{color:#b03020}.aside{color:#9a6500}"
    "@media(max-width:48rem){main{margin:0;border:0;border-radius:0;padding:1rem}}"
)


class Shown(NamedTuple):
    """What a page shows."""

    title: str
    subject: Subject
    """the object with its scores, contacts and anchor"""
    curves: Curves
    stages: list[Stage]
    video: Path | None
    video_problem: str | None
    """why there is none"""
    result: dict[str, Any]


def demo_page(shown: Shown) -> str:
    """The page."""
    result = shown.result
    aside = result["as_asked"] is False
    colour = ("aside" if aside else "held") if result["success"] else "failed"
    words = f"<p class='verdict {colour}'>{html.escape(verdict(result))}</p>"
    heat = Image.fromarray(draw(shown.subject, _PIXELS, _PIXELS))
    buffer = io.BytesIO()
    heat.save(buffer, format="png", optimize=True)
    sections = [
        _section("The grasp", _video(shown)),
        _section("Stages", _image(stage_plot(shown.stages), "the stages over time")),
        _section(
            "Where to grasp",
            _image(buffer.getvalue(), "the heatmap with the chosen three points")
            + "<p class='note'>Yellow suits the thumb best. Red: the thumb's contact; white: where "
            "index and middle finger aim, to either side of the point that opposes the thumb, "
            "rings where that is on the far side; a cross: the anchor.</p>",
        ),
        _section("In numbers", _numbers(shown.result)),
        _section("Over time", _image(grasp_plot(shown.curves, shown.stages), "curves over time")),
        _section("Everything", _facts(shown.result)),
    ]
    style = asset_path("report.css").read_text() + _PHONE
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width,initial-scale=1'>"
        f"<title>mjx_grasp: {html.escape(shown.title)}</title><style>{style}</style></head>"
        f"<body><main><h1>{html.escape(shown.title)}</h1>{words}{''.join(sections)}"
        "</main></body></html>\n"
    )


def verdict(result: dict[str, Any]) -> str:
    """What came of a grasp, where it was asked to be and why it failed, in words."""
    grasp = result["grasp"]
    if result["success"]:
        words = "lifted and held"
    else:
        words, why = (grasp[which].replace("_", " ") for which in ("outcome", "failure"))
        if why not in ("none", words):
            words += f": {why}"
    if (apart := result["from_anchor_mm"]) is None:
        return words
    if result["as_asked"] or not result["success"]:
        words += ", "
    else:
        words += ", but not where it was asked for: "
    words += f"contacts {apart:.0f} mm from the place, {result['at_best_mm']:.0f} at best"
    if before := [each["from_anchor_mm"] for each in result["tries"][:-1]]:
        tries = "a try" if len(before) == 1 else f"{len(before)} tries, the nearest"
        words += f", after {tries} at {min(before):.0f} mm"
    return words


def _numbers(result: dict[str, Any]) -> str:
    grasp = result["grasp"]
    errors = grasp["tip_error_mm"]
    rows = {
        "mass": _with(result["mass_kg"], "kg"),
        "handoff after": _with(grasp["handoff_s"], "s"),
        "lift begins after": _with(grasp["lift_s"], "s"),
        "lifted after": _with(grasp["lifted_s"], "s"),
        "tips at the handoff": "none"
        if errors is None
        else ", ".join(f"{e:g}" for e in errors) + " mm (thumb, index, middle)",
        "mean force per finger": _with(grasp["force_mean_n"], "N"),
        "largest force": _with(grasp["force_peak_n"], "N"),
        "tries": str(len(result["tries"])),
        "new plans": str(grasp["replans"]),
        "returns to reaching": str(grasp["returns"]),
    }
    if result["from_anchor_mm"] is not None:
        apart, best = result["from_anchor_mm"], result["at_best_mm"]
        rows["contacts from the anchor"] = f"{apart:g} mm, {best:g} mm at best"
    made = ", ".join(f"{name} {seconds:g} s" for name, seconds in result["seconds"].items())
    rows["computed in"] = made
    return (
        "<dl>"
        + "".join(f"<dt>{k}</dt><dd>{html.escape(v)}</dd>" for k, v in rows.items())
        + ("</dl>")
    )


def _with(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.2f} {unit}"


def _video(shown: Shown) -> str:
    if shown.video is None:
        return f"<p class='note'>No film. {html.escape(shown.video_problem or '')}</p>"
    data = base64.b64encode(shown.video.read_bytes()).decode()
    source = f"data:video/mp4;base64,{data}"
    return f"<video src='{source}' controls autoplay loop muted playsinline></video>"


def _facts(result: dict[str, Any]) -> str:
    text = html.escape(json.dumps(result, indent=2, ensure_ascii=False))
    return f"<details><summary>result.json</summary><pre>{text}</pre></details>"


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"


def _image(data: bytes, alt: str) -> str:
    return f"<img alt='{alt}' src='data:image/png;base64,{base64.b64encode(data).decode()}'>"
