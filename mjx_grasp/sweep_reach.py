"""`python -m mjx_grasp.sweep_reach`: how often the reaching controller reaches, and how fast.

Thousands of randomised cylinders on the table, reached for from home by kinematic integration of
the controller's commands, all in one batch on whatever device JAX finds. Prints the rates by
tolerance and time beside the publication's.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from mjx_grasp.atomic import replacing, write_json
from mjx_grasp.cli import run_command
from mjx_grasp.compilation import compile_seconds
from mjx_grasp.errors import InputError
from mjx_grasp.provenance import provenance
from mjx_grasp.reaching.body import reach_body
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import PlanConfig, start_library
from mjx_grasp.reaching.poses import CylinderPoses, PoseDistribution, draw_poses
from mjx_grasp.reaching.presets import Preset, for_sweep, preset
from mjx_grasp.reaching.results import classify, rate_table, residual_table, summary
from mjx_grasp.reaching.sweep import ReachRecord, plan_all, sweep
from mjx_grasp.robot.spec import load_robot

TUNING_SEEDS = (1, 2, 3)
"""Poses on which settings were chosen; results that count come from others."""


@dataclass(frozen=True)
class SweepConfig:
    """What to sweep."""

    poses: int = 2752
    """randomised cylinder poses [-]"""
    seed: int = 2752
    """of the poses; 1, 2 and 3 were used to choose settings"""
    preset: str = "default"
    """paper, standoffs, escape, reachability, guide or default"""
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
        if self.poses < 1:
            raise InputError("poses", self.poses, "a whole number from 1")
        if self.chunk is not None and self.chunk < 1:
            raise InputError("chunk", self.chunk, "a whole number from 1")
        for name, suffix in (("out", ".json"), ("plot", ".png"), ("gallery", ".png")):
            path = getattr(self, name)
            if path is not None and path.suffix != suffix:
                raise InputError(name, str(path), f"a file name ending in {suffix}")


@dataclass(frozen=True)
class SweepRun:
    """Everything a sweep made."""

    result: dict[str, Any]
    poses: CylinderPoses
    record: ReachRecord
    classes: np.ndarray
    """``[poses]`` failure class of each, −1 where it converged."""


def run_sweep(
    config: SweepConfig, settings: Preset | None = None, console: Console | None = None
) -> SweepRun:
    """Draws the poses, plans where the preset looks ahead, reaches for all, sums up.

    Args:
        config: What to sweep.
        settings: In place of the named preset's.
        console: Where progress is shown; nowhere if None.

    Raises:
        InputError: An unknown preset or robot.
        FileError: The robot's description cannot be read.
    """
    settings = for_sweep(settings or preset(config.preset))
    body = reach_body(load_robot(config.robot))
    reacher = Reacher(body, settings.reach, settings.selection)
    poses = draw_poses(config.poses, config.seed)
    on_cpu = jax.default_backend() == "cpu"
    chunk = min(config.chunk or (128 if on_cpu else config.poses), config.poses)
    dt, cap = settings.reach.controller.dt, settings.reach.controller.timeout
    seconds: dict[str, float] = {}
    plans, least_error = None, None
    with _progress(console) as progress:
        if settings.plan or config.bound:
            plan = settings.plan or PlanConfig()
            task = progress.add_task("library of starts", total=None)
            start, compiled = time.perf_counter(), compile_seconds()
            library = start_library(body, plan)
            progress.update(task, visible=False)
            task = progress.add_task("inverse kinematics", total=config.poses)
            found = plan_all(
                reacher,
                plan,
                library,
                poses,
                min(chunk, 32) if on_cpu else min(chunk, 256),
                lambda done: progress.update(task, completed=done),
            )
            seconds["planning"] = time.perf_counter() - start - compile_seconds() + compiled
            least_error = found.least_error
            plans = found.plans if settings.plan else None
        task = progress.add_task("reaching", total=config.poses * round(cap / dt))
        start, compiled = time.perf_counter(), compile_seconds()
        record = sweep(reacher, poses, plans, chunk, lambda ticks: progress.advance(task, ticks))
        seconds["reaching"] = time.perf_counter() - start - compile_seconds() + compiled
    limits = settings.reach.limits
    result = summary(body, limits, poses, record, least_error)
    seconds["compilation"] = compile_seconds()
    result["seconds"] = {name: round(value, 2) for name, value in seconds.items()}
    classes = classify(body, limits, record, least_error)
    return SweepRun(result, poses, record, classes)


def results_file(config: SweepConfig, settings: Preset, result: dict[str, Any]) -> dict[str, Any]:
    """The contents of a results file."""
    return {
        "provenance": provenance(config.seed),
        "tuning_seeds": TUNING_SEEDS,
        "preset": config.preset,
        "distribution": asdict(PoseDistribution()),
        "settings": asdict(settings),
        **result,
    }


def _progress(console: Console | None) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=console is None,
    )


def main() -> None:
    """Parses the command line, sweeps, prints the tables, writes what was asked for."""
    config = tyro.cli(SweepConfig, description=__doc__)
    console = Console()
    settings = for_sweep(preset(config.preset))
    run = run_sweep(config, console=console)
    console.print(rate_table(run.result, config.preset))
    console.print(residual_table(run.result, config.preset))
    failures = ", ".join(f"{n} {v:.1f} %" for n, v in run.result["failures_percent"].items() if v)
    console.print(f"failures at 20 mm and 3 s: {failures or 'none'}")
    if config.out:
        write_json(config.out, results_file(config, settings, run.result))
        console.print(f"written: {config.out}")
    if config.plot or config.gallery:
        from mjx_grasp.reaching.pictures import failure_gallery, rate_plot

        if config.plot:
            with replacing(config.plot) as temporary:
                temporary.write_bytes(rate_plot(run.result, config.preset))
            console.print(f"written: {config.plot}")
        if config.gallery:
            robot = load_robot(config.robot)
            failure_gallery(config.gallery, robot, run.poses, run.record, run.classes)
            console.print(f"written: {config.gallery}")


if __name__ == "__main__":
    run_command(main)
