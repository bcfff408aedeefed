"""Default against steered: which three contacts are chosen for a place that is asked for.

python experiments/steering_figure.py --objects-dir SCANS
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.progress import track
from small_png import write_png
from steering_numbers import DEFAULT, measures, scores, seen

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.colours import steered_shade
from mjx_grasp.heatmap.sampling import best_triple
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Share
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet
from mjx_grasp.viz.heatmap import Subject, best_axes, subject_of

SCHEMA = "mjx_grasp.steering/2"
DRAWN = {DEFAULT: "default", "axis": "axis", "contacts": "contacts"}
"""The heatmap's own scores, the publication's steering, and that by the contacts."""

CASES = (
    ("mustard_bottle", "the top"),
    ("pitcher_base_scaled", "by the handle"),
    ("wine_glass", "by the stem"),
    ("power_drill", "by the handle"),
    ("mug", "by the handle"),
    ("large_clamp", "at the jaws"),
)
"""Three of the publication's four cases and its pitcher by another part, with two more tools."""


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one, and where there is no scan"""
    out: Path = Path("docs/steering.png")
    results: Path = Path("experiments/results/steering.json")
    brightest: Share = 0.05
    """share of a panel's candidates that get the yellow end of its scale [-]"""
    cell_pixels: Count = 240
    max_kb: Count = 400
    """largest picture"""


def main(config: FigureConfig) -> None:
    """Computes, draws and writes."""
    made = provenance(0)  # before anything is written, so that the revision is not dirty by it
    hand = load_robot().hand
    rows: list[dict[str, Any]] = []
    cells: dict[str, list[Cell]] = {kind: [] for kind in DRAWN}
    for name, instruction in track(CASES, "steering", console=Console(stderr=True)):
        obj = seen(name, config.objects_dir, hand)
        anchor = obj.anchor(instruction)
        drawn: dict[str, tuple[Subject, float]] = {}
        for kind, score in scores(obj.heatmap, anchor):
            triple = best_triple(obj.heatmap, score)
            row = {"object": name, "mesh": obj.source, "instruction": instruction}
            row |= {"steering": kind, **measures(obj.heatmap, triple, anchor)}
            rows.append(row)
            shade = steered_shade(score, config.brightest)
            subject = subject_of(obj.heatmap, obj.mesh.faces, shade, triple, anchor.point)
            drawn[kind] = subject, row["contacts_mm"]
        axes = best_axes(drawn["contacts"][0])
        for kind, label in DRAWN.items():
            subject, distance = drawn[kind]
            title = name.replace("_", " ") if kind == DEFAULT else f"“{instruction}”, {label}"
            cells[kind].append(Cell(title, f"contacts at {distance:.0f} mm", subject, axes))
    sheet = contact_sheet(
        [cell for kind in DRAWN for cell in cells[kind]],
        "Steering",
        "default; the grasp's axis near the anchor, as published; all three contacts near it. Mean "
        "distance of the chosen contacts from the anchor",
        columns=len(CASES),
        cell_pixels=config.cell_pixels,
        scale="root of the score over each picture's best",
    )
    write_png(config.out, sheet, 1000 * config.max_kb)
    settings = {"span_m": hand.span, "friction": hand.scoring_friction}
    write_json(
        config.results, {"schema": SCHEMA, "rows": rows, "settings": settings, "provenance": made}
    )
    print(f"written: {config.out}, {config.results}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
