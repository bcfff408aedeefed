"""What an error of the object's pose at the handoff costs: success over a grid of errors.

The hand stands at its handoff while the object is moved sideways by up to so much along x and y and
turned by up to so much about a random axis, which is what a wrong pose is to a policy that does not
see. All controllers have the same draws. A controller that is in the file already, of the same
settings and revision of the code, is left alone, so that an interrupted run goes on.

  python experiments/pose_error.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from compared import (
    ComparedConfig,
    Comparison,
    Condition,
    Runner,
    compared,
    compiled_for,
    journal_of,
    keep,
)
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.evaluation.trials import evenly, room_for
from mjx_grasp.records.journal import journaled
from mjx_grasp.records.settings import NonNegative
from mjx_grasp.tasks.config import StartNoise

SCHEMA = "mjx_grasp.pose_error/1"
_WHAT = "a table of pose errors"
Cells = tuple[str, Sequence[Condition]]
"""A controller, and errors that are tried beside each other."""


@dataclass(frozen=True)
class PoseErrorConfig(ComparedConfig):
    """Which controllers, and which errors."""

    out: Path = Path("experiments/results/pose_error.json")
    offsets_mm: tuple[NonNegative, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    angles_deg: tuple[NonNegative, ...] = (0.0, 5.0, 10.0)


def conditions(config: PoseErrorConfig) -> list[Condition]:
    """The cells of the grid."""
    return [
        (
            {"offset_mm": offset, "angle_deg": angle},
            StartNoise(offset_m=1e-3 * offset, angle_rad=math.radians(angle)),
        )
        for angle in config.angles_deg
        for offset in config.offsets_mm
    ]


def batches(config: PoseErrorConfig, found: Comparison) -> list[Sequence[Condition]]:
    """The cells that are tried beside each other."""
    room = room_for(config.engine, config.episodes * len(found.names))
    return evenly(conditions(config), room)


def _runner(config: PoseErrorConfig) -> Runner:
    """What each of several processes needs."""
    found, widest = compared(config, SCHEMA, _WHAT), max(n.angle_rad for _, n in conditions(config))
    most = max(map(len, batches(config, found)))
    drawn = config.episodes, config.seed, config.engine
    return Runner(found, *drawn, angle_rad=widest, beside=most)


def _rows(runner: Runner, cells: Cells) -> list[list[dict[str, Any]]]:
    return runner.rows(*cells)


def main(config: PoseErrorConfig) -> None:
    """Runs what is not there yet."""
    found = compared(config, SCHEMA, _WHAT)
    beside = batches(config, found)
    done = found.record["controllers"]
    left = [name for name in found.contestants if name not in done]
    cells = [
        (f"{name}, {[at for at, _ in some]}", (name, some)) for name in left for some in beside
    ]
    journal = journal_of(config, found)
    setup = partial(_runner, config)
    kinds = {name: compiled_for(who) for name, who in found.contestants.items()}
    results = journaled(config, _rows, cells, setup, journal, kind=lambda of: kinds[of[0]])
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("conditions", total=len(left) * sum(map(len, beside)))
        for name in left:
            rows = []
            for some in beside:
                for own in next(results):
                    rows += own
                bar.update(job, advance=len(some))
            done[name] = rows
            keep(config, found)
    journal.close()


if __name__ == "__main__":
    import pose_error as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.PoseErrorConfig, description=__doc__)))
