"""The reach sweep of the published controller, and of each addition to it, on the same poses.

python experiments/reach_ablation.py --out experiments/results/reach_ablation.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_grasp.atomic import write_json
from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.layout import Table
from mjx_grasp.provenance import provenance
from mjx_grasp.reaching.presets import PRESETS
from mjx_grasp.reaching.results import PAPER_RATE
from mjx_grasp.reaching.sweep import BUDGETS
from mjx_grasp.reaching.sweep_run import run_sweep
from mjx_grasp.sweep_reach import TUNING_SEEDS, SweepConfig

_KEPT = (
    "rate_percent",
    "rate_percent_since_start",
    "at_20mm_3s",
    "failures_percent",
    "handoff_mm",
    "limits",
    "seconds",
)


@dataclass(frozen=True)
class AblationConfig:
    """What to compare."""

    out: Path
    """results file to write (.json)"""
    poses: int = 2752
    seed: int = SweepConfig().seed
    chunk: int | None = None


def table(rows: dict[str, dict[str, Any]]) -> Table:
    """Rates within 20 mm and 10 mm, and median errors of the wraps at handoff."""
    header = ("", *(f"{t} mm, {b} s" for t in (20, 10) for b in (1, 3, 7)), "wraps mm", "seconds")
    cells = []
    for name, row in rows.items():
        rate = [row["rate_percent"][t][b] for t in ("20", "10") for b in ("1", "3", "7")]
        wraps = "/".join(
            f"{row['handoff_mm'][f]['median']:.1f}" if f in row["handoff_mm"] else "-"
            for f in ("index", "middle")
        )
        seconds = row["seconds_to_20mm"]["50"]
        shown = "-" if seconds is None else f"{seconds:.2f}"
        cells.append((name, *(f"{v:.1f}" for v in rate), wraps, shown))
    paper = {t: dict(zip(BUDGETS, PAPER_RATE[t], strict=True)) for t in ("20", "10")}
    published = [f"{paper[t][b]:.1f}" for t in ("20", "10") for b in (1.0, 3.0, 7.0)]
    cells.append(("published", *published, "14.2/17.1", ""))
    return Table("Reaches converged [%], each row with one addition", header, tuple(cells))


def main(config: AblationConfig) -> None:
    """Sweeps with every preset, prints the table, writes the file after each."""
    console = Console()
    rows: dict[str, dict[str, Any]] = {}
    for name in PRESETS:
        console.print(name)
        sweep = SweepConfig(
            poses=config.poses, seed=config.seed, preset=name, bound=False, chunk=config.chunk
        )
        result = run_sweep(sweep, console=console).result
        rows[name] = {k: result[k] for k in (*_KEPT, "seconds_to_20mm")}
        write_json(
            config.out,
            {
                "provenance": provenance(config.seed),
                "tuning_seeds": TUNING_SEEDS,
                "poses": config.poses,
                "rows": rows,
                "markdown": table(rows).markdown(),
            },
        )
    console.print(table(rows))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(AblationConfig, description=__doc__)))
