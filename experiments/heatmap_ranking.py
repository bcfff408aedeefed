"""Ranks objects by a summary of their heatmaps, and says where four difficult ones stand.

Those four are large or awkward (mini soccer ball, pitcher base, power drill, toy airplane);
their ranks are written down whichever way they come out. Rank 1 is the best, equals share a rank.
The summaries: the mean of the best 5 % of an object's scores (the order of the rows), and the share
of vertices that score above 0.3.

  python experiments/heatmap_ranking.py --objects-dir SCANS
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.compute import compute_heatmaps, heatmap_surface
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Share
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.heatmap_ranking/1"
WATCHED = ("mini_soccer_ball", "pitcher_base", "power_drill", "toy_airplane")


@dataclass(frozen=True)
class RankingConfig(CommandSettings):
    """What to rank."""

    objects: tuple[str, ...] = ("train",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    best_share: Share = 0.05
    """share of the vertices whose mean score ranks an object"""
    good_score: Share = 0.3
    """vertices above this count as good"""
    out: Path = Path("experiments/results/heatmap_ranking.json")


def main(config: RankingConfig) -> None:
    """Ranks, and writes the file."""
    names = resolve(config.objects)
    meshes = [heatmap_surface(object_mesh(name, config.objects_dir)) for name in names]
    hand = load_robot().hand
    heatmaps = compute_heatmaps(
        [(np.asarray(m.vertices), np.asarray(m.faces)) for m in meshes],
        None,
        hand.span,
        hand.scoring_friction,
    )
    rows = [
        {"object": name} | summary(np.asarray(h.score), np.asarray(h.valid), config)
        for name, h in zip(names, heatmaps, strict=True)
    ]
    for key in ("best_mean", "good_share"):
        for row in rows:
            row[f"rank_by_{key}"] = 1 + sum(other[key] > row[key] for other in rows)
    rows.sort(key=lambda r: r["rank_by_best_mean"])
    document = {
        "schema": SCHEMA,
        "provenance": provenance(seed=0),
        "source": "parametric" if config.objects_dir is None else "scan",
        "best_share": config.best_share,
        "good_score": config.good_score,
        "watched": watched(rows),
        "rows": rows,
    }
    write_json(config.out, document)
    for r in rows:
        print(
            f"{r['rank_by_best_mean']:3d}  {r['object']:22s} {r['best_mean']:.3f}"
            f"  {100 * r['good_share']:5.1f} %  (rank {r['rank_by_good_share']})"
        )
    print(json.dumps(document["watched"], indent=1))


def summary(score: np.ndarray, valid: np.ndarray, config: RankingConfig) -> dict[str, Any]:
    """The summaries of one heatmap."""
    best = np.sort(score)[::-1][: max(1, round(config.best_share * len(score)))]
    return {
        "vertices": len(score),
        "best_mean": float(best.mean()),
        "good_share": float((score > config.good_score).mean()),
        "max": float(score.max()),
        "valid_share": float(valid.mean()),
    }


def watched(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Where the four objects stand, and whether they are the last four."""
    ranks = {r["object"]: r["rank_by_best_mean"] for r in rows if r["object"] in WATCHED}
    shares = {r["object"]: r["rank_by_good_share"] for r in rows if r["object"] in WATCHED}
    last = {r["object"] for r in rows[-len(WATCHED) :]}
    return {
        "of": len(rows),
        "rank_by_best_mean": ranks,
        "rank_by_good_share": shares,
        "among_the_last_four": sorted(last & set(WATCHED)),
        "last_four": [r["object"] for r in rows[-len(WATCHED) :]],
    }


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(RankingConfig, description=__doc__)))
