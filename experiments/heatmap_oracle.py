"""How well the heatmap agrees with an independent double-precision one, scan by scan.

The other implementation is tests/heatmap/oracle.py (NumPy, SciPy, trimesh, embree). A vertex
agrees if its score is within 1e-4; each other one is put into a class by the decision that rounding
took the other way (tests/heatmap/agreement.py).

  python experiments/heatmap_oracle.py --objects-dir SCANS
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import track

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.robot.spec import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "heatmap"))
import agreement
import oracle

SCHEMA = "mjx_grasp.heatmap_oracle/1"
BACKENDS = ("bvh", "brute")


@dataclass(frozen=True)
class OracleConfig(CommandSettings):
    """What to compare."""

    objects: tuple[str, ...] = ("train",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    out: Path = Path("experiments/results/heatmap_oracle.json")


def main(config: OracleConfig) -> None:
    """Compares, and writes the file."""
    names = resolve(config.objects)
    hand = load_robot().hand
    rows = []
    for name in track(names, "comparing", console=Console(stderr=True), transient=True):
        mesh = object_mesh(name, config.objects_dir)
        result = oracle.heatmap(mesh, hand.span, hand.scoring_friction)
        for backend in BACKENDS:
            heatmap = compute_heatmap(
                mesh.vertices,
                mesh.faces,
                None,
                hand.span,
                hand.scoring_friction,
                HeatmapConfig(backend=backend),
            )
            found = agreement.compare(heatmap, result)
            rows.append(
                {
                    "object": name,
                    "backend": backend,
                    "vertices": found.vertices,
                    "faces": len(mesh.faces),
                    "agree": found.agree,
                    "agree_percent": 100.0 * found.share,
                    "max_difference": found.max_difference,
                    "exceptions": found.classes,
                }
            )
    document = {
        "schema": SCHEMA,
        "provenance": provenance(seed=0),
        "source": "parametric" if config.objects_dir is None else "scan",
        "score_tolerance": agreement.AGREE,
        "summary": {backend: summary(rows, backend) for backend in BACKENDS},
        "rows": rows,
    }
    write_json(config.out, document)
    print(json.dumps(document["summary"], indent=1))


def summary(rows: list[dict], backend: str) -> dict:
    """Of all objects together."""
    mine = [r for r in rows if r["backend"] == backend]
    classes = {c for r in mine for c in r["exceptions"]}
    return {
        "vertices": sum(r["vertices"] for r in mine),
        "agree": sum(r["agree"] for r in mine),
        "least_agree_percent": min(r["agree_percent"] for r in mine),
        "exceptions": {c: sum(r["exceptions"].get(c, 0) for r in mine) for c in sorted(classes)},
    }


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(OracleConfig, description=__doc__)))
