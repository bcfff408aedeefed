"""The heatmaps of all train objects on one sheet.

python experiments/heatmap_figure.py --objects-dir SCANS

A run that was killed goes on after the objects that it had finished.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from small_png import write_png

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.sampling import best_triple
from mjx_grasp.heatmap.summary import GOOD, Row, summary_table
from mjx_grasp.objects.catalogue import load_catalogue, resolve
from mjx_grasp.objects.meshes import find_scan
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.archive import packed, unpacked
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, to_record
from mjx_grasp.robot.description import HandSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet
from mjx_grasp.viz.heatmap import Subject, subject_of

SCHEMA = "mjx_grasp.heatmaps/1"


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    objects: tuple[str, ...] = ("train",)
    """objects or groups"""
    out: Path = Path("docs/heatmaps.png")
    results: Path = Path("experiments/results/heatmaps.json")
    columns: Count = 7
    cell_pixels: Count = 220
    max_kb: Count = 400
    """largest picture"""


def main(config: FigureConfig) -> None:
    """Computes, draws and writes."""
    made = provenance(0)  # before anything is written, so that the revision is not dirty by it
    hand = load_robot().hand
    identity = to_record(config) | {"device": made["device"]}  # times are of one
    journal = Journal(config.results, identity, made["git"])
    rows, cells = [], []
    for name in track(resolve(config.objects), "heatmaps", console=Console(stderr=True)):
        found = journal.once(name, looked_at, name, config.objects_dir, hand)
        row, subject = Row(**found["row"]), Subject(**unpacked(found["subject"]))
        rows.append(row)
        cells.append(Cell(name.replace("_", " "), f"best {row.best_score:.2f}", subject))
    span = [1e3 * length for length in hand.span]
    subtitle = f"hand span {span[0]:g} to {span[1]:g} mm, friction {hand.scoring_friction:g}"
    start = time.perf_counter()
    sheet = contact_sheet(
        cells, "Grasp-affordance heatmaps", subtitle, config.columns, config.cell_pixels
    )
    drawing = time.perf_counter() - start
    write_png(config.out, sheet, 1000 * config.max_kb)
    meshes = [asdict(row) for row in rows]
    content = {
        "schema": SCHEMA,
        "rows": meshes,
        "drawing_seconds": drawing,
        "provenance": made,
    }
    write_json(config.results, content)
    journal.close()
    Console().print(summary_table(rows))
    print(f"written: {config.out}, {config.results}")


def looked_at(name: str, objects_dir: Path | None, hand: HandSpec) -> dict[str, Any]:
    """An object's row, and what is drawn of it."""
    mesh, file = heatmap_surface(object_mesh(name, objects_dir)), "stand-in"
    if objects_dir is not None:
        file = find_scan(objects_dir, load_catalogue()[name].scan_names).name
    start = time.perf_counter()
    heatmap = compute_heatmap(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), None, hand.span, hand.scoring_friction
    )
    heatmap = jax.tree.map(np.asarray, heatmap)
    seconds = time.perf_counter() - start
    best, share = float(heatmap.score.max()), float(np.mean(heatmap.score > GOOD))
    row = Row(name, file, len(mesh.vertices), len(mesh.faces), best, share, seconds)
    subject = subject_of(heatmap, mesh.faces, triple=best_triple(heatmap))
    drawn = {what: array for what, array in vars(subject).items() if array is not None}
    return {"row": asdict(row), "subject": packed(drawn)}


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
