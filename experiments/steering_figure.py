"""Default against steered selection: how near the chosen contacts come to the place asked for.

python experiments/steering_figure.py --objects-dir SCANS
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from small_png import write_png

from mjx_grasp.cli import run_command
from mjx_grasp.geometry.vectors import distance_to_line
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.sampling import Triples, best_triple
from mjx_grasp.heatmap.steering import Heatmap, steer, steer_near
from mjx_grasp.language.grounding import target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet
from mjx_grasp.viz.heatmap import Subject, best_axes, subject_of

SCHEMA = "mjx_grasp.steering/1"
KINDS = ("default", "in line", "between contacts")
"""The heatmap's own scores, the publication's steering, and this project's stricter one."""

CASES = (
    ("mustard_bottle", "the top"),
    ("pitcher_base_scaled", "the body"),
    ("pitcher_base", "the rim"),
    ("wine_glass", "by the stem"),
    ("power_drill", "by the handle"),
    ("large_clamp", "at the jaws"),
)
"""The publication's four cases, with a second part of the pitcher and a second tool."""


@dataclass(frozen=True)
class FigureConfig(CommandSettings):
    """What to draw."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one, and where there is no scan"""
    drawn_sigma: Positive = 0.020
    """of the steered pictures [m]"""
    sigmas: tuple[Positive, ...] = (0.030, 0.020)
    """of the results [m]"""
    out: Path = Path("docs/steering.png")
    results: Path = Path("experiments/results/steering.json")
    cell_pixels: Count = 240
    max_kb: Count = 400
    """largest picture"""


def main(config: FigureConfig) -> None:
    """Computes, draws and writes."""
    made = provenance(0)  # before anything is written, so that the revision is not dirty by it
    hand = load_robot().hand
    rows: list[dict[str, Any]] = []
    cells: dict[str, list[Cell]] = {kind: [] for kind in KINDS}
    for name, instruction in track(CASES, "steering", console=Console(stderr=True)):
        has_scan = load_catalogue()[name].split != "figure_only"
        objects_dir = config.objects_dir if has_scan else None
        mesh = heatmap_surface(object_mesh(name, objects_dir))
        source = "scan" if objects_dir else "stand-in"
        heatmap = compute_heatmap(
            np.asarray(mesh.vertices), np.asarray(mesh.faces), None, hand.span,
            hand.scoring_friction,
        )  # fmt: skip
        heatmap = jax.tree.map(np.asarray, heatmap)
        target = target_of(name, mesh, load_catalogue()[name].parts_on(source == "scan"))
        anchor = PartGrounder().ground(instruction, target).point
        drawn: dict[str, tuple[Subject, float]] = {}
        for kind, sigma in _conditions(config.sigmas):
            score = _score(heatmap, kind, anchor, sigma)
            triple = best_triple(heatmap, jnp.asarray(score))
            row = {
                "object": name,
                "mesh": source,
                "instruction": instruction,
                "anchor_m": anchor.tolist(),
                "steering": kind,
                "sigma_m": sigma,
                **_distances(heatmap, triple, anchor),
            }
            rows.append(row)
            if sigma in (None, config.drawn_sigma):
                # Relative to the best: steering lowers all scores of a far place alike.
                relative = score / max(float(score.max()), 1e-12)
                subject = subject_of(heatmap, mesh.faces, relative, triple, anchor)
                drawn[kind] = subject, row["contacts_mm"]
        axes = best_axes(drawn[KINDS[-1]][0])
        for kind, (subject, distance) in drawn.items():
            title = name.replace("_", " ") if kind == KINDS[0] else f"“{instruction}”, {kind}"
            cells[kind].append(Cell(title, f"contacts at {distance:.0f} mm", subject, axes))
    sheet = contact_sheet(
        [cell for kind in KINDS for cell in cells[kind]],
        "Steering",
        f"default; in line with the anchor, sigma {1e3 * config.drawn_sigma:g} mm; with the anchor "
        "between the contacts. Mean distance of the three chosen contacts from the anchor",
        columns=len(CASES),
        cell_pixels=config.cell_pixels,
        scale="score over the best one",
    )
    write_png(config.out, sheet, 1000 * config.max_kb)
    settings = {"span_m": hand.span, "friction": hand.scoring_friction}
    content = {
        "schema": SCHEMA,
        "rows": rows,
        "settings": settings,
        "provenance": made,
    }
    write_json(config.results, content)
    Console().print(_table(rows))
    print(f"written: {config.out}, {config.results}")


def _conditions(sigmas: tuple[float, ...]) -> list[tuple[str, float | None]]:
    return [(KINDS[0], None), *((kind, sigma) for kind in KINDS[1:] for sigma in sigmas)]


def _score(heatmap: Heatmap, kind: str, anchor: np.ndarray, sigma: float | None) -> np.ndarray:
    if sigma is None:
        return np.asarray(heatmap.score)
    steering = {KINDS[1]: steer, KINDS[2]: steer_near}[kind]
    return np.asarray(steering(heatmap, jnp.asarray(anchor), sigma))


def _distances(heatmap: Heatmap, triple: Triples, anchor: np.ndarray) -> dict[str, Any]:
    """How far the chosen triple is from the anchor [mm]."""
    contacts = np.concatenate([triple.thumb, triple.wrap[0]])
    apart = 1e3 * np.linalg.norm(contacts - anchor, axis=1)
    line = distance_to_line(jnp.asarray(anchor), triple.thumb[0], triple.axis[0])
    return {
        "score": float(triple.score[0]),
        "score_without_com": float(heatmap.score_without_com[int(triple.candidate[0])]),
        "thumb_mm": float(apart[0]),
        "index_mm": float(apart[1]),
        "middle_mm": float(apart[2]),
        "contacts_mm": float(apart.mean()),
        "axis_mm": 1e3 * float(line),
        "contacts_m": contacts.tolist(),
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(
        "object", "instruction", "steering", "sigma [mm]", "contacts [mm]", "axis [mm]", "score"
    )
    for row in rows:
        sigma = "" if row["sigma_m"] is None else f"{1e3 * row['sigma_m']:g}"
        cells = (f"{row['contacts_mm']:.1f}", f"{row['axis_mm']:.1f}", f"{row['score']:.2f}")
        table.add_row(row["object"], row["instruction"], row["steering"], sigma, *cells)
    return table


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FigureConfig, description=__doc__)))
