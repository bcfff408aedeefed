"""Heatmap and steering times: per scan, for all, against trimesh and embree, and as meshes grow.

The reference is tests/heatmap/oracle.py: the same score in NumPy, rays by embree, nearest points by
trimesh, neighbourhoods by SciPy's k-d tree. Times are medians of `--repeats` runs in this process,
from NumPy arrays to scores that are ready on the device; first calls, with compilation, stand
apart. Runs unchanged on a CPU and on a GPU; `--skip-reference` where embree is missing.

  python benchmarks/heatmap.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
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

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.backends import backend_for
from mjx_grasp.heatmap.compute import compute_heatmap, compute_heatmaps
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import steer, steer_many
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import check_writable, replacing, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.heatmap_benchmark/1"
TESTS = Path(__file__).resolve().parent.parent / "tests" / "heatmap"
# Arithmetic per pair of query and face, counted in the code: ray, neighbourhood, nearest point.
PAIR_OPERATIONS = {"rays": 45, "neighbourhoods": 40, "nearest": 95}
# Each stage writes a matrix of all pairs and reads it: twice for its extremum, more for the sums.
PAIR_BYTES = {"rays": 12, "neighbourhoods": 40, "nearest": 12}
LARGEST_BRUTE = {"cpu": 6_000, "gpu": 210_000}


@dataclass(frozen=True)
class BenchmarkConfig(CommandSettings):
    """What to measure."""

    out: Path
    plot: Path | None = None
    """PNG of the growth; beside the JSON by default"""
    objects: tuple[str, ...] = ("train",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    repeats: Count = 7
    skip_reference: bool = False
    growth: tuple[Count, ...] = (1_000, 3_000, 10_000, 30_000, 100_000, 200_000)
    """faces of the meshes that the growth is measured on"""


def timed(run: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Median time of a run that waits for its result, and how much longer the first took [s]."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    median = statistics.median(times[1:])
    return median, times[0] - median


def knot(faces: int) -> tuple[np.ndarray, np.ndarray]:
    """A wavy ring with about so many faces of about the same size."""
    minor = max(8, round((faces / 5) ** 0.5))
    mesh = trimesh.creation.torus(
        0.03, 0.012, major_sections=int(2.5 * minor), minor_sections=minor
    )
    v = np.asarray(mesh.vertices)
    return v + 0.002 * np.sin(90 * v[:, [1, 2, 0]]), np.asarray(mesh.faces)


def ceilings() -> dict[str, float]:
    """What this device reaches: float32 products [op/s] and copies [B/s]."""
    n = 1024 if jax.default_backend() == "cpu" else 8192
    a = jnp.ones((n, n), jnp.float32)
    product = jax.jit(lambda x: jnp.dot(x, x, precision=jax.lax.Precision.HIGHEST))
    long = jnp.ones(2**26 if n == 1024 else 2**30, jnp.float32)
    copy = jax.jit(lambda x: x + 1.0)
    return {
        "float32_op_per_s": 2 * n**3 / timed(lambda: product(a), 5)[0],
        "copy_bytes_per_s": 8 * len(long) / timed(lambda: copy(long), 5)[0],
    }


def distance_from_limit(
    vertices: int, faces: int, offsets: int, seconds: dict[str, float], limits: dict[str, float]
) -> dict[str, Any]:
    """What the work would take at the device's measured ceilings, and which of them is nearer."""
    queries = {"rays": 1, "neighbourhoods": 1, "nearest": 2 * offsets}
    pairs = {k: n * vertices * faces for k, n in queries.items()}
    operations = sum(pairs[k] * PAIR_OPERATIONS[k] for k in pairs)
    moved = sum(pairs[k] * PAIR_BYTES[k] for k in pairs)
    must_move = 4 * (6 * vertices + 13 * faces + 45 * vertices)
    at = {
        "brute_arithmetic_s": operations / limits["float32_op_per_s"],
        "brute_memory_s": moved / limits["copy_bytes_per_s"],
        "input_and_output_s": must_move / limits["copy_bytes_per_s"],
    }
    if jax.default_backend() == "cpu":
        at["brute_memory_s"] = 0.0  # its tiles are made to stay in the cache
    bound = "arithmetic" if at["brute_arithmetic_s"] > at["brute_memory_s"] else "memory"
    return {
        "brute_pairs": sum(pairs.values()),
        "brute_operations": operations,
        "brute_bytes": moved,
        "input_and_output_bytes": must_move,
        "ceilings": limits,
        **at,
        "brute_is_bound_by": bound,
        "share_of_limit": {
            "brute": max(at["brute_arithmetic_s"], at["brute_memory_s"]) / seconds["brute"],
            # With a tree most pairs are never met: only the data are compulsory.
            "bvh_against_brute_limit": max(at["brute_arithmetic_s"], at["brute_memory_s"])
            / seconds["bvh"],
            "bvh_against_input_and_output": at["input_and_output_s"] / seconds["bvh"],
        },
        "bvh_is_bound_by": "branches and scattered reads of tree traversals",
    }


def peak_memory(faces: int) -> float:
    """Peak resident memory of a fresh process that does one such mesh on the CPU [bytes]."""
    code = (
        "import resource, sys; sys.path.insert(0, sys.argv[1]); import heatmap;"
        "heatmap.compute_heatmap(*heatmap.knot(int(sys.argv[2])), None, (0.02, 0.09), 0.5)"
        ".score.block_until_ready();"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent), str(faces)],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=True,
    )
    return 1024.0 * float(done.stdout.split()[-1])


def measure(config: BenchmarkConfig) -> dict[str, Any]:
    hand = load_robot().hand
    meshes = {name: object_mesh(name, config.objects_dir) for name in resolve(config.objects)}
    arrays = {n: (np.asarray(m.vertices), np.asarray(m.faces)) for n, m in meshes.items()}
    console = Console(stderr=True)

    def one(v, f, backend="auto"):
        settings = HeatmapConfig(backend=backend)
        return compute_heatmap(v, f, None, hand.span, hand.scoring_friction, settings)

    per_scan = []
    for name, (v, f) in track(arrays.items(), "scans", console=console, transient=True):
        row: dict[str, Any] = {"object": name, "vertices": len(v), "faces": len(f)}
        row["seconds"], row["first_call_extra_s"] = timed(
            lambda v=v, f=f: one(v, f), config.repeats
        )
        row["backend"] = backend_for(len(f), HeatmapConfig())
        if not config.skip_reference:
            row |= reference(meshes[name], hand, row["seconds"])
        per_scan.append(row)

    def everything():
        found = compute_heatmaps(list(arrays.values()), None, hand.span, hand.scoring_friction)
        return [h.score for h in found]

    all_s, all_first = timed(everything, config.repeats)
    heatmap = one(*max(arrays.values(), key=lambda a: len(a[0])))
    anchors = np.random.default_rng(0).normal(0, 0.03, (1000, 3)).astype(np.float32)
    rounds = 20 * config.repeats
    steer_s, steer_first = timed(lambda: steer(heatmap, anchors[0]), rounds)
    many_s, many_first = timed(lambda: steer_many(heatmap, anchors), rounds)

    growth = []
    platform = "cpu" if jax.default_backend() == "cpu" else "gpu"
    for faces in track(config.growth, "growth", console=console, transient=True):
        v, f = knot(faces)
        row = {"vertices": len(v), "faces": len(f), "seconds": {}, "first_call_extra_s": {}}
        for backend in ("bvh", "brute"):
            if backend == "brute" and len(f) > LARGEST_BRUTE[platform]:
                continue
            repeats = config.repeats if faces <= 10_000 else 1
            taken = timed(lambda b=backend, v=v, f=f: one(v, f, b), repeats)
            row["seconds"][backend], row["first_call_extra_s"][backend] = taken
        growth.append(row)

    largest = max(arrays.values(), key=lambda a: len(a[1]))
    both = {b: timed(lambda b=b: one(*largest, b), config.repeats)[0] for b in ("bvh", "brute")}
    limit = distance_from_limit(
        *map(len, largest), len(HeatmapConfig().wrap_offsets), both, ceilings()
    )
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "provenance": provenance(seed=0),
        "source": "parametric" if config.objects_dir is None else "scan",
        "repeats": config.repeats,
        "summary": {
            "scans": len(arrays),
            "median_seconds_per_scan": statistics.median(r["seconds"] for r in per_scan),
            "largest_seconds_per_scan": max(r["seconds"] for r in per_scan),
            "all_scans_in_one_call_s": all_s,
            "all_scans_first_call_extra_s": all_first,
            "largest_scan_by_backend_s": both,
            "candidates_steered": len(heatmap.score),
            "steer_s": steer_s,
            "steer_first_call_extra_s": steer_first,
            "steer_1000_anchors_s": many_s,
            "steer_1000_anchors_first_call_extra_s": many_first,
        },
        "limit": limit,
        "scans": per_scan,
        "growth": growth,
    }
    if not config.skip_reference:
        ratios = [r["times_faster"] for r in per_scan if r["vertices"] > 2000]
        if ratios:
            document["summary"]["times_faster_than_reference"] = {
                "of_scans_with_over_2000_vertices": len(ratios),
                "median": statistics.median(ratios),
                "least": min(ratios),
            }
    if jax.default_backend() == "cpu":
        document["peak_memory_bytes"] = {str(n): peak_memory(n) for n in config.growth[-1:]}
    return document


def reference(mesh: trimesh.Trimesh, hand: Any, seconds: float) -> dict[str, Any]:
    """The median of three runs of the reference, each on a mesh without cached properties."""
    sys.path.insert(0, str(TESTS))
    import oracle

    runs = []
    for _ in range(3):
        fresh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        start = time.perf_counter()
        stages = oracle.heatmap(fresh, hand.span, hand.scoring_friction).seconds
        runs.append((time.perf_counter() - start, stages))
    taken, stages = sorted(runs, key=lambda run: run[0])[1]
    return {
        "reference_s": taken,
        "reference_stages_s": stages,
        "times_faster": taken / seconds,
    }


def draw(document: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for backend in ("bvh", "brute"):
        rows = [r for r in document["growth"] if backend in r["seconds"]]
        axes.loglog(
            [r["faces"] for r in rows],
            [1e3 * r["seconds"][backend] for r in rows],
            marker="o",
            label=backend,
        )
    axes.set(xlabel="faces", ylabel="heatmap [ms]", title=document["provenance"]["device"])
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)
    plt.close(figure)


def main(config: BenchmarkConfig) -> None:
    """Measures, writes the file and the plot, prints the summary."""
    check_writable("--out", config.out)
    document = measure(config)
    write_json(config.out, document)
    draw(document, config.plot or config.out.with_suffix(".png"))
    shown = ("summary", "limit", "growth", "peak_memory_bytes")
    print(json.dumps({k: document[k] for k in shown if k in document}, indent=1))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchmarkConfig, description=__doc__)), keeps=False)
