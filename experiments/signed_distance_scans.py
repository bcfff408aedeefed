"""How well the distance grids that reaching avoids objects by agree with trimesh, scan by scan.

Points on the surface and within 10 mm of it; their distances from trimesh's nearest points in
double precision, their signs from its ray casts.

The normals that come with the distances: their lengths, their angles to central finite differences
of the same grid's distances (in double precision), and to trimesh's directions from or to its
nearest points. Left out are points within half a cell of the surface, where that direction is
rounding, and within one cell of the medial axis, where there are two.

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
from markdown_tables import markdown
from rich.console import Console
from rich.progress import track
from scans import has_scan

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.geometry.distance_field import distance_field
from mjx_grasp.geometry.signed_distance import (
    DistanceField,
    distance_and_normal,
    signed_distance,
)
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed
from mjx_grasp.records.table import Table

SCHEMA = "mjx_grasp.signed_distance/2"
# Step of the finite differences, [m]: so small that hardly any cross a cell's border.
STEP = 1e-6
# A normal that turns by more than this against the step to a point one cell away has passed the
# medial axis [-]: from 17° to 30° by its direction, or a surface with a radius of 3 cells there.
RIDGE = 0.3
# To the middles of the faces and the corners of a cube.
AROUND = np.array(
    [d for d in np.ndindex(3, 3, 3) if np.abs(np.subtract(d, 1)).sum() in (1, 3)], float
)
AROUND = (AROUND - 1) / np.linalg.norm(AROUND - 1, axis=1, keepdims=True)


@dataclass(frozen=True)
class DistanceConfig(CommandSettings):
    """What to compare."""

    objects_dir: Path
    """folder of real scans"""
    objects: tuple[str, ...] = ("all",)
    spacing: Positive = 0.0015
    """of the grid [m]"""
    near: Positive = 0.010
    """how far from the surface points are drawn [m]"""
    count: Count = 4000
    """points on the surface, and as many near it [-]"""
    count_normals: Count = 1000
    """points of those near it whose normals are compared [-]"""
    seed: Seed = 0
    out: Path = Path("experiments/results/signed_distance_scans.json")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count_normals > self.count:
            raise InputError(self.name_of("count_normals"), self.count_normals, "at most --count")


def exact_normals(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances by trimesh, negative inside, and its directions away from the inside."""
    nearest, distance, _ = trimesh.proximity.closest_point(mesh, points)
    inside = mesh.contains(points)
    away = (points - nearest) / np.maximum(distance, 1e-12)[:, None]
    return np.where(inside, -distance, distance), np.where(inside[:, None], -away, away)


def finite_differences(field: DistanceField, points: np.ndarray) -> np.ndarray:
    """Central, of the grid's own distances, in double precision."""
    with jax.enable_x64(True):
        double = DistanceField(*(jnp.asarray(leaf, jnp.float64) for leaf in field))
        sides = [
            signed_distance(double, jnp.asarray(points + side * STEP * axis))
            for axis in np.eye(3)
            for side in (1, -1)
        ]
        slopes = [
            np.asarray(a - b) / (2 * STEP) for a, b in zip(sides[::2], sides[1::2], strict=True)
        ]
    return np.stack(slopes, axis=-1)


def angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Between rows [deg]; by the sine too, which is exact for small ones."""
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.rad2deg(np.arctan2(sine, np.sum(first * second, axis=1)))


def compare_normals(
    mesh: trimesh.Trimesh, field: DistanceField, points: np.ndarray
) -> dict[str, Any]:
    """Percentiles of the errors of the grid's normals at points."""
    cell = float(field.spacing)
    distance, exact = exact_normals(mesh, points)
    around = (points[:, None] + cell * AROUND).reshape(-1, 3)
    turned = exact_normals(mesh, around)[1].reshape(len(points), -1, 3) - exact[:, None]
    # Outside distances are the least of those to several parts, inside the greatest.
    against = -np.sign(distance)[:, None] * np.sum(turned * AROUND, axis=-1)
    kept = (np.abs(distance) > 0.5 * cell) & (against.max(axis=1) < RIDGE)
    points, exact = points[kept], exact[kept]
    normal = distance_and_normal(field, jnp.asarray(points, jnp.float32))[1]
    normal = np.asarray(normal, np.float64)
    errors = {
        "normal_to_finite_differences_deg": angles(normal, finite_differences(field, points)),
        "normal_to_trimesh_deg": angles(normal, exact),
        "normal_length_off_by": np.abs(np.linalg.norm(normal, axis=1) - 1),
    }
    return {
        "normals_left_out_percent": round(100 * float(1 - kept.mean()), 1),
        **{
            name: {str(q): float(f"{np.percentile(e, q):.3g}") for q in (50, 95)}
            for name, e in errors.items()
        },
    }


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
        **compare_normals(mesh, field, points[config.count :][: config.count_normals]),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """One line per object."""
    shown = ("worst_mm", "percentile_95_mm", "points_above_1_mm_percent", "right_signs_percent")
    normals = ("normal_to_finite_differences_deg", "normal_to_trimesh_deg", "normal_length_off_by")
    return Table(
        "Distance grids against trimesh",
        (
            "object",
            "worst mm",
            "95 % mm",
            "above 1 mm %",
            "right signs %",
            *(f"{what}, 50 % / 95 %" for what in ("slope °", "normal °", "length")),
        ),
        tuple(
            (
                r["object"].replace("_", " "),
                *(f"{r[k]:.2f}" for k in shown),
                *(f"{r[k]['50']:.3f} / {r[k]['95']:.3f}" for k in normals),
            )
            for r in rows
        ),
    )


def main(config: DistanceConfig) -> None:
    """Compares, prints the table, writes the file after each object."""
    console = Console(stderr=True)
    made = {"schema": SCHEMA, "provenance": provenance(config.seed)}
    rows: list[dict[str, Any]] = []
    without_scan: list[str] = []
    for name in track(resolve(config.objects), "comparing", console=console, transient=True):
        if not has_scan(name, config.objects_dir):
            without_scan.append(name)
            continue
        rows.append({"object": name, **compare(object_mesh(name, config.objects_dir), config)})
        document = {
            **made,
            "spacing_mm": 1e3 * config.spacing,
            "near_mm": 1e3 * config.near,
            "points": 2 * config.count,
            "points_normals": config.count_normals,
            "without_scan": without_scan,
            "rows": rows,
            "markdown": markdown(table(rows)),
        }
        write_json(config.out, document)
    Console().print(table(rows))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(DistanceConfig, description=__doc__)))
