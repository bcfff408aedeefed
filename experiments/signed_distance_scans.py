"""How well the distance grids that reaching avoids objects by agree with trimesh, scan by scan.

Points on the surface and within 10 mm of it; their distances from trimesh's nearest points in
double precision, their signs from its ray casts.

  python experiments/signed_distance_scans.py --objects-dir SCANS
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from rich.console import Console
from rich.progress import track

from mjx_grasp.atomic import write_json
from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.layout import Table
from mjx_grasp.geometry.distance_field import distance_field
from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.objects.catalogue import load_catalogue, resolve
from mjx_grasp.objects.meshes import centred, find_scan, read_mesh
from mjx_grasp.provenance import provenance

SCHEMA = "mjx_grasp.signed_distance/1"


@dataclass(frozen=True)
class DistanceConfig:
    """What to compare."""

    objects_dir: Path
    """folder of real scans"""
    objects: tuple[str, ...] = ("all",)
    spacing: float = 0.0015
    """of the grid [m]"""
    near: float = 0.010
    """how far from the surface points are drawn [m]"""
    count: int = 4000
    """points on the surface, and as many near it [-]"""
    seed: int = 0
    out: Path = Path("experiments/results/signed_distance_scans.json")

    def __post_init__(self):
        if self.count < 1:
            raise InputError("count", self.count, "a whole number from 1")


def compare(mesh: trimesh.Trimesh, config: DistanceConfig) -> dict[str, Any]:
    """Errors of one mesh's grid, [mm], and the share of right signs."""
    start = time.perf_counter()
    field = distance_field(mesh.vertices, mesh.faces, config.spacing)
    field = jax.block_until_ready(field)
    seconds = time.perf_counter() - start
    rng = np.random.default_rng(config.seed)
    on, face = trimesh.sample.sample_surface(mesh, config.count, seed=config.seed)
    offset = rng.uniform(-config.near, config.near, (config.count, 1))
    points = np.concatenate([on, on + offset * mesh.face_normals[face]])
    exact = trimesh.proximity.signed_distance(mesh, points)
    found = -np.asarray(signed_distance(field, jnp.asarray(points, jnp.float32)), np.float64)
    error = 1e3 * np.abs(found - exact)
    # At the surface itself the sign is rounding.
    clear = np.abs(exact) > 0.5 * config.spacing
    return {
        "faces": len(mesh.faces),
        "grid": list(field.values.shape),
        "seconds": round(seconds, 2),
        "worst_mm": round(float(error.max()), 3),
        "percentile_95_mm": round(float(np.percentile(error, 95)), 3),
        "median_mm": round(float(np.median(error)), 3),
        "points_above_1_mm_percent": round(100.0 * float(np.mean(error > 1.0)), 3),
        "right_signs_percent": round(
            100.0 * float(np.mean((found > 0)[clear] == (exact > 0)[clear])), 3
        ),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """One line per object."""
    shown = ("worst_mm", "percentile_95_mm", "points_above_1_mm_percent", "right_signs_percent")
    return Table(
        "Distance grids against trimesh",
        ("object", "worst mm", "95 % mm", "above 1 mm %", "right signs %"),
        tuple((r["object"].replace("_", " "), *(f"{r[k]:.2f}" for k in shown)) for r in rows),
    )


def main(config: DistanceConfig) -> None:
    """Compares, prints the table, writes the file after each object."""
    console = Console(stderr=True)
    made = {"schema": SCHEMA, "provenance": provenance(config.seed)}
    rows: list[dict[str, Any]] = []
    without_scan: list[str] = []
    for name in track(resolve(config.objects), "comparing", console=console, transient=True):
        info = load_catalogue()[name]
        try:
            scan = find_scan(config.objects_dir, info.scan_names)
        except FileError:
            without_scan.append(name)
            continue
        mesh = centred(read_mesh(scan)[0], info.scale)
        rows.append({"object": name, **compare(mesh, config)})
        document = {
            **made,
            "spacing_mm": 1e3 * config.spacing,
            "near_mm": 1e3 * config.near,
            "points": 2 * config.count,
            "without_scan": without_scan,
            "rows": rows,
            "markdown": table(rows).markdown(),
        }
        write_json(config.out, document)
    Console().print(table(rows))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(DistanceConfig, description=__doc__)))
