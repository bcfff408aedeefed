"""What an error of the object's pose at the handoff costs: success over a grid of errors.

The hand stands at its handoff while the object is moved sideways by up to so much along x and y and
turned by up to so much about a random axis, which is what a wrong pose is to a policy that does not
see. All controllers have the same draws. A controller that is in the file already, of the same
settings and revision of the code, is left alone, so that an interrupted run goes on.

  python experiments/pose_error.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import tyro
from compared import ComparedConfig, compared, ran
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.settings import NonNegative
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.config import StartNoise

SCHEMA = "mjx_grasp.pose_error/1"


@dataclass(frozen=True)
class PoseErrorConfig(ComparedConfig):
    """Which controllers, and which errors."""

    out: Path = Path("experiments/results/pose_error.json")
    offsets_mm: tuple[NonNegative, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    angles_deg: tuple[NonNegative, ...] = (0.0, 5.0, 10.0)


def conditions(config: PoseErrorConfig) -> list[tuple[dict[str, float], StartNoise]]:
    """What each cell of the grid is called, and what is drawn in it."""
    return [
        (
            {"offset_mm": offset, "angle_deg": angle},
            StartNoise(offset_m=1e-3 * offset, angle_rad=math.radians(angle)),
        )
        for angle in config.angles_deg
        for offset in config.offsets_mm
    ]


def main(config: PoseErrorConfig) -> None:
    """Runs what is not there yet."""
    grid = conditions(config)
    found = compared(config, SCHEMA, "a table of pose errors")
    world, done = found.world(SceneConfig()), found.record["controllers"]
    left = {name: who for name, who in found.contestants.items() if name not in done}
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("controllers", total=len(left))
        for name, who in left.items():
            done[name] = ran(world, found.names, who, grid, config)
            write_json(config.out, found.record)
            bar.update(job, advance=1)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PoseErrorConfig, description=__doc__)))
