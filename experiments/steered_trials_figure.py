"""Grasps at the places that the publication asks for, from home to the hold, as pictures.

    python experiments/steered_trials_figure.py --objects-dir SCANS

Poses are tried by their seeds until one succeeds; the results file says what came of each. A run
that was killed goes on after the poses that it had tried.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont
from renderer import check_films
from rich.console import Console
from small_png import write_png

from mjx_grasp.cli import run_command
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.records.archive import packed, unpacked
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, to_record
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.demo.run import run_demo
from mjx_grasp.viz.frames import Frame

SCHEMA = "mjx_grasp.steered_trials/1"
CASES = (
    ("mustard_bottle", "the top"),
    ("pitcher_base_scaled", "around the middle"),
    ("wine_glass", "by the stem"),
    ("power_drill", "by the handle"),
)
"""Those of the publication's figure: top of a bottle, body of a pitcher, stem of a glass, handle of
a tool."""
_INK, _PAPER, _GREY = (34, 40, 49), (255, 255, 255), (110, 116, 124)
_LEFT, _HEAD, _GAP = 190, 34, 6
_FILM_FPS = 25


@dataclass(frozen=True)
class TrialsConfig(CommandSettings):
    """What to try and where the picture goes."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one, and where there is no scan"""
    tries: Count = 5
    """poses of each at most [-]"""
    seed: Seed = 0
    """of the first pose"""
    cell_pixels: Count = 270
    """width of a picture"""
    max_kb: Count = 600
    """largest picture"""
    out: Path = Path("docs/steered_trials.png")
    results: Path = Path("experiments/results/steered_trials.json")


def main(config: TrialsConfig) -> None:
    """Grasps, draws, writes."""
    check_writable("--out", config.out)
    check_writable("--results", config.results)
    check_films()  # pictures come last, after minutes
    made, console = provenance(config.seed), Console(stderr=True)
    identity = to_record(config) | {"device": made["device"]}
    journal = Journal(config.results, identity, made["git"])
    rows, strips = [], []
    for name, instruction in CASES:
        row, strip = tried(name, instruction, config, console, journal)
        rows.append(row)
        strips.append(strip)
    write_png(config.out, sheet(rows, strips, config.cell_pixels), 1000 * config.max_kb)
    write_json(config.results, {"schema": SCHEMA, "rows": rows, "provenance": made})
    journal.close()
    console.print(f"written: {config.out}, {config.results}")


def tried(
    name: str, instruction: str, config: TrialsConfig, console: Console, journal: Journal
) -> tuple[dict[str, Any], list[Frame]]:
    """What came of an object's poses, and pictures of the last one tried."""
    outcomes: list[str] = []
    for seed in range(config.seed, config.seed + config.tries):
        pose = f"{name}, seed {seed}"
        found = journal.once(pose, grasped, name, instruction, seed, config, console)
        outcomes.append(found["outcome"])
        console.print(f"{pose}: {outcomes[-1]}")
        if found["row"]["success"]:
            break
    row = found["row"] | {"outcomes": outcomes, "seed": seed}
    return row, list(unpacked(found["film"])["frames"])


def grasped(
    name: str, instruction: str, seed: int, config: TrialsConfig, console: Console
) -> dict[str, Any]:
    """What came of one pose, and pictures of it."""
    scanned = load_catalogue()[name].split != "figure_only"
    with tempfile.TemporaryDirectory() as folder:
        demo = DemoConfig(
            name,
            instruction=instruction,
            objects_dir=config.objects_dir if scanned else None,
            seed=seed,
            out=Path(folder) / "demo",
        )
        result = run_demo(demo, console)
        film = list(iio.imiter(demo.out / "grasp.mp4"))
    kept = ("object", "mesh", "asked", "from_anchor_mm", "at_best_mm", "success", "phases")
    frames = np.array([film[k] for k in moments(result["phases"], len(film))])
    return {
        "outcome": result["grasp"]["outcome"],
        "row": {key: result[key] for key in kept},
        "film": packed({"frames": frames}),
    }


def moments(phases: list[dict[str, Any]], frames: int) -> list[int]:
    """Frames of a film: the beginning, late in the reach, when the lift begins, and the end.

    Args:
        phases: With their names and times; the last of each name counts.
        frames: Of the film.
    """
    begins = {phase["name"]: phase["start"] for phase in phases}
    ends = {phase["name"]: phase["end"] for phase in phases}
    reached = begins["reaching"] + 0.75 * (ends["reaching"] - begins["reaching"])
    lifts = begins.get("lifting", ends["reaching"])
    times = (0.0, reached, lifts, np.inf)
    return [int(min(time * _FILM_FPS, frames - 1)) for time in times]


def sheet(rows: list[dict[str, Any]], strips: list[list[Frame]], width: int) -> Image.Image:
    """The pictures, a line per case, with what was asked and what came of it."""
    height = round(width * strips[0][0].shape[0] / strips[0][0].shape[1])
    whole = (_LEFT + len(strips[0]) * (width + _GAP), _HEAD + len(rows) * (height + _GAP))
    image = Image.new("RGB", whole, _PAPER)
    ink = ImageDraw.Draw(image)
    fonts = ImageFont.load_default(17), ImageFont.load_default(13)
    for k, title in enumerate(("from home", "reach", "closed", "held")):
        ink.text((_LEFT + k * (width + _GAP) + 4, 8), title, _INK, fonts[0])
    for line, (row, strip) in enumerate(zip(rows, strips, strict=True)):
        top = _HEAD + line * (height + _GAP)
        asked = row["asked"].partition(" (")[0]
        failed = len(row["outcomes"]) - row["success"]
        said = (
            (row["object"].replace("_", " "), fonts[0], _INK),
            (asked, fonts[0], _INK),
            (f"contacts {row['from_anchor_mm']:.0f} mm from it,", fonts[1], _GREY),
            (f"{row['at_best_mm']:.0f} mm at best", fonts[1], _GREY),
            (row["outcomes"][-1].replace("_", " ") + f", pose {row['seed']}", fonts[1], _GREY),
            (f"{failed} before it failed" if failed and row["success"] else "", fonts[1], _GREY),
        )
        for k, (text, font, colour) in enumerate(said):
            ink.text((4, top + 24 + 24 * k), text, colour, font)
        for k, frame in enumerate(strip):
            small = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
            image.paste(small, (_LEFT + k * (width + _GAP), top))
    return image


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(TrialsConfig, description=__doc__)), alone=True)
