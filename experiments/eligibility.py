"""Which objects have grasp candidates, what limits those that have none, and the settings tried.

An object is eligible for a heatmap if any point of its refined surface scores as much as pre-grasps
ask for; whether the hand then finds a pre-grasp is for `python -m mjx_grasp.handoffs` to say. What
limits an object is the term of the score that, set to 1 at every point, raises its best score most.
The settings that the publication leaves open are compared by how many of the training objects are
eligible, by where the four objects stand that it reports as difficult (ranks by the share of the
surface that is eligible: the four lowest are 25 to 28), and by how much they change on the eight.
A run that was killed goes on after the settings that it had finished.

  python experiments/eligibility.py --objects-dir SCANS
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from rich.console import Console
from rich.progress import track

from mjx_grasp.cli import run_command
from mjx_grasp.geometry.mesh import vertex_areas
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.heatmap.compute import compute_heatmaps, heatmap_surface
from mjx_grasp.heatmap.config import PUBLISHED, HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, to_record
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.eligibility/1"
DIFFICULT = ("mini_soccer_ball", "pitcher_base", "power_drill", "toy_airplane")
SMALL_OFFSET = HeatmapConfig().wrap_offsets
SETTINGS = {
    "published": PUBLISHED,
    "opposition 0.7": replace(PUBLISHED, opposition_width=0.7),
    "coherence 60°": replace(PUBLISHED, coherence_angle=float(np.radians(60.0))),
    "opposition 0.7, coherence 60°": replace(
        PUBLISHED, opposition_width=0.7, coherence_angle=float(np.radians(60.0))
    ),
    "smallest offset 5 mm": replace(PUBLISHED, wrap_offsets=SMALL_OFFSET),
    "narrow tail 25 mm": replace(PUBLISHED, narrow_sigma=0.025),
    "default: both": HeatmapConfig(),
}


@dataclass(frozen=True)
class EligibilityConfig(CommandSettings):
    """What to look at."""

    objects: tuple[str, ...] = ("train", "held_out")
    """objects or groups; settings are compared on the training objects among them alone"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    out: Path = Path("experiments/results/eligibility.json")


def main(config: EligibilityConfig) -> None:
    """Computes, and writes the file."""
    made = provenance(0)
    names, least = resolve(config.objects), SamplingConfig().min_score
    training, eight = resolve(("train",)), resolve(("eight",))
    names = tuple(dict.fromkeys((*names, *(n for n in eight if n not in names))))
    surfaces = {n: heatmap_surface(object_mesh(n, config.objects_dir)) for n in names}
    identity = to_record(config) | {"device": made["device"]}  # which decides what searches
    journal = Journal(config.out, identity, made["git"])
    every = {
        name: journal.once(name, _found, surfaces, settings, least, eight)
        for name, settings in track(SETTINGS.items(), "settings", console=Console(stderr=True))
    }
    first = next(iter(SETTINGS))
    rows = [
        {"object": n, "held_out": n not in (*training, *eight), "faces": len(surfaces[n].faces)}
        | {name: every[name]["rows"][n] for name in (first, "default: both")}
        for n in names
    ]
    compared = []
    for name, found in every.items():
        share = {n: found["rows"][n]["share"] for n in training if n in surfaces}
        kept = [_kept(every[first]["candidates"][n], found["candidates"][n]) for n in eight]
        compared.append(
            {
                "settings": name,
                "eligible": sum(s > 0 for s in share.values()),
                "of": len(share),
                "without": [n for n, s in share.items() if s == 0],
                "ranks": {n: 1 + sum(s > share[n] for s in share.values()) for n in DIFFICULT},
                "overlap_of_the_eight": {"least": min(kept), "mean": float(np.mean(kept))},
            }
        )
    document = {
        "schema": SCHEMA,
        "provenance": made,
        "source": "parametric" if config.objects_dir is None else "scan",
        "min_score": least,
        "default": to_record(HeatmapConfig()),
        "rows": rows,
        "compared": compared,
    }
    write_json(config.out, document)
    journal.close()
    for row in compared:
        print(row)
    print(f"written: {config.out}")


def _found(
    surfaces: dict[str, trimesh.Trimesh],
    settings: HeatmapConfig,
    least: float,
    watched: Sequence[str],
) -> dict[str, Any]:
    """Rows of all objects by some settings, and the candidates of those that are watched."""
    maps = _maps(surfaces, settings)
    areas = {
        n: vertex_areas(np.asarray(s.vertices), np.asarray(s.faces)) for n, s in surfaces.items()
    }
    return {
        "rows": {n: _row(maps[n], areas[n], least) for n in surfaces},
        "candidates": {
            n: np.flatnonzero(np.asarray(maps[n].score) >= least).tolist() for n in watched
        },
    }


def _maps(surfaces: dict[str, trimesh.Trimesh], settings: HeatmapConfig) -> dict[str, Heatmap]:
    hand = load_robot().hand
    meshes = [(np.asarray(s.vertices), np.asarray(s.faces)) for s in surfaces.values()]
    maps = compute_heatmaps(meshes, None, hand.span, hand.scoring_friction, settings)
    return dict(zip(surfaces, maps, strict=True))


def _row(heatmap: Heatmap, area: np.ndarray, least: float) -> dict[str, Any]:
    """How many candidates there are, on how much of the surface, and what limits the best."""
    score = np.asarray(heatmap.score)
    suits = score >= least
    limit, best = _limit({name: np.asarray(t) for name, t in heatmap.terms.items()}, score)
    at = int(np.argmax(score))
    return {
        "candidates": int(suits.sum()),
        "share": float(area[suits].sum() / area.sum()),
        "best": float(score.max()),
        "width_mm": 1e3 * float(heatmap.width[at]),
        "limit": limit,
        "best_without_it": best,
    }


def _limit(terms: dict[str, np.ndarray], score: np.ndarray) -> tuple[str, float]:
    """The term without which the best score would be highest, and that score."""

    def without(name: str) -> float:
        others: Sequence[np.ndarray] = [t for other, t in terms.items() if other != name]
        return float(np.prod(others, axis=0).max()) if len(score) else 0.0

    name = max(terms, key=without)
    return name, without(name)


def _kept(before: Sequence[int], after: Sequence[int]) -> float:
    """Candidates in both over candidates in either."""
    a, b = set(before), set(after)
    return len(a & b) / max(1, len(a | b))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(EligibilityConfig, description=__doc__)))
