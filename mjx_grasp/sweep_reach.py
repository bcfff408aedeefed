"""`python -m mjx_grasp.sweep_reach`: how often the reaching controller reaches, and how fast.

Thousands of randomised cylinders on the table, reached for from home by kinematic integration of
the controller's commands, all in one batch on whatever device JAX finds. Prints the rates by
tolerance and time beside the publication's.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import check_writable, replacing, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.identity import RobotIdentity

if TYPE_CHECKING:
    from mjx_grasp.reaching.presets import ReachPreset


@dataclass(frozen=True)
class SweepConfig:
    """What to sweep."""

    poses: int = 2752
    """randomised cylinder poses [-]"""
    seed: int = 20
    """of the poses; 1, 2, 3 and 2752 were used to choose settings"""
    preset: str = "default"
    """paper, standoffs, escape, reachability, guide, straight, clearance or default"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    bound: bool = True
    """also report the share of poses for which a solution exists at all"""
    chunk: int | None = None
    """poses worked on at once; by default 128 on a CPU, all of them on an accelerator [-]"""
    out: Path | None = None
    """results file to write (.json)"""
    plot: Path | None = None
    """plot to write (.png)"""
    gallery: Path | None = None
    """pictures of failures to write (.png); needs MUJOCO_GL=egl on a machine without a screen"""

    def __post_init__(self):
        for name, suffix in (("out", ".json"), ("plot", ".png"), ("gallery", ".png")):
            path = getattr(self, name)
            if path is not None and path.suffix != suffix:
                raise InputError(name, str(path), f"a file name ending in {suffix}")


def check_gallery(config: SweepConfig) -> None:
    """Pictures come last, after minutes: what they need is looked for first.

    Raises:
        InputError: A gallery is asked for where MuJoCo cannot render.
    """
    if config.gallery is None:
        return
    from mjx_grasp.viz import frames, video

    try:
        frames.check_backend()
    except frames.BackendError as error:
        backend = os.environ.get("MUJOCO_GL")
        found = f"no renderer with MUJOCO_GL={backend}" if backend else "no renderer"
        raise InputError(
            "gallery",
            f"{config.gallery}, but {found} ({error})",
            f"a renderer for the pictures: MUJOCO_GL=egl without a screen; {video.INSTALL}",
        ) from error


def results_file(
    config: SweepConfig, settings: ReachPreset, robot: RobotIdentity, result: dict[str, Any]
) -> dict[str, Any]:
    """The contents of a results file."""
    from mjx_grasp.evaluation.reach.poses import TUNING_SEEDS, PoseDistribution

    return {
        "provenance": provenance(config.seed),
        "robot": to_record(robot),
        "tuning_seeds": TUNING_SEEDS,
        "preset": config.preset,
        "distribution": asdict(PoseDistribution()),
        "settings": asdict(settings),
        **result,
    }


def main() -> None:
    """Parses the command line, sweeps, prints the tables, writes what was asked for."""
    config = tyro.cli(SweepConfig, description=__doc__)
    for name in ("out", "plot", "gallery"):
        if getattr(config, name) is not None:
            check_writable(name, getattr(config, name))
    check_gallery(config)
    # They import MuJoCo, which fails where MUJOCO_GL names a backend that is missing.
    from mjx_grasp.evaluation.reach.results import rate_table, residual_table
    from mjx_grasp.evaluation.reach.run import run_sweep
    from mjx_grasp.reaching.presets import for_sweep, preset
    from mjx_grasp.robot.spec import load_robot

    console = Console()
    settings, robot = for_sweep(preset(config.preset)), load_robot(config.robot)
    run = run_sweep(
        robot,
        settings,
        config.poses,
        config.seed,
        chunk=config.chunk,
        bound=config.bound,
        console=console,
    )
    console.print(rate_table(run.result, config.preset))
    console.print(residual_table(run.result, config.preset))
    failures = ", ".join(f"{n} {v:.1f} %" for n, v in run.result["failures_percent"].items() if v)
    console.print(f"failures at 20 mm and 3 s: {failures or 'none'}")
    if config.out:
        write_json(config.out, results_file(config, settings, robot.identity, run.result))
        console.print(f"written: {config.out}")
    if config.plot or config.gallery:
        from mjx_grasp.viz.reach import failure_gallery, rate_plot

        if config.plot:
            with replacing(config.plot) as temporary:
                temporary.write_bytes(rate_plot(run.result, config.preset))
            console.print(f"written: {config.plot}")
        if config.gallery:
            failure_gallery(config.gallery, robot, run.poses, run.record, run.classes)
            console.print(f"written: {config.gallery}")


if __name__ == "__main__":
    run_command(main)
