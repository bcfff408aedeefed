"""The reach sweep of the published controller, and of each addition to it, on the same poses.

python experiments/reach_ablation.py --out experiments/results/reach_ablation.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from reach_tables import ablation_table
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.reach.poses import TUNING_SEEDS, SweepConfig
from mjx_grasp.evaluation.reach.run import run_sweep
from mjx_grasp.reaching.presets import PRESETS
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed
from mjx_grasp.robot.spec import load_robot

_KEPT = (
    "rate_percent",
    "rate_percent_since_start",
    "rate_percent_since_first_near",
    "reaches_that_changed_plan_percent",
    "at_20mm_3s",
    "failures_percent",
    "handoff_mm",
    "limits",
    "seconds",
    "seconds_to_20mm",
    "solvable_percent",
)


@dataclass(frozen=True)
class AblationConfig(CommandSettings):
    """What to compare."""

    out: Path
    """results file to write (.json)"""
    poses: Count = 2752
    seed: Seed = SweepConfig().seed
    chunk: Count | None = None
    resume: bool = False
    """keep the rows that the results file has already"""
    sweeps: tuple[Path, ...] = ()
    """results of `sweep_reach` on the same poses, whose presets need not be swept again"""


def known_rows(config: AblationConfig) -> dict[str, dict[str, Any]]:
    """Rows that are there already, each with its provenance.

    Raises:
        InputError: They are of other poses.
        FileError: A file cannot be read.
    """
    rows: dict[str, dict[str, Any]] = {}
    for path in (*([config.out] if config.resume else []), *config.sweeps):
        stored = read_json(path, "results of a sweep")
        try:
            made = stored["provenance"]
            asked = {"poses": config.poses, "seed": config.seed}
            found = {"poses": stored["poses"], "seed": made["seed"]}
            new = stored["rows"] if "rows" in stored else {stored["preset"]: stored}
        except (KeyError, TypeError) as error:
            raise FileError(path, f"no results to keep ({error!r})", "those of a sweep") from None
        if found != asked:
            raise InputError(str(path), found, str(asked))
        for name, row in new.items():
            kept = {k: row[k] for k in _KEPT if k in row}
            rows[name] = kept | {"provenance": row.get("provenance", made)}
    return rows


def main(config: AblationConfig) -> None:
    """Sweeps with every preset, prints the table, writes the file after each."""
    console = Console()
    known = known_rows(config)
    rows: dict[str, dict[str, Any]] = {}
    robot = load_robot()
    for name, settings in PRESETS.items():
        console.print(name)
        if name in known:
            rows[name] = known[name]
        else:
            run = run_sweep(
                robot,
                settings,
                config.poses,
                config.seed,
                chunk=config.chunk,
                bound=False,
                console=console,
            )
            rows[name] = {k: run.result[k] for k in _KEPT if k in run.result}
            rows[name]["provenance"] = provenance(config.seed)
        write_json(
            config.out,
            {
                "provenance": provenance(config.seed),
                "tuning_seeds": TUNING_SEEDS,
                "poses": config.poses,
                "rows": rows | {k: v for k, v in known.items() if k not in rows},
            },
        )
    console.print(ablation_table(rows))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(AblationConfig, description=__doc__)))
