"""The reach sweep from its settings to its numbers: poses, plans, reaches (method §3)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.compilation import compile_seconds
from mjx_grasp.reaching.body import reach_body
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import PlanConfig, start_library
from mjx_grasp.reaching.poses import CylinderPoses, draw_poses
from mjx_grasp.reaching.presets import Preset, for_sweep, preset
from mjx_grasp.reaching.results import classify, summary
from mjx_grasp.reaching.sweep import ReachRecord, plan_all, sweep
from mjx_grasp.robot.spec import load_robot

if TYPE_CHECKING:
    from mjx_grasp.sweep_reach import SweepConfig


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
    with counting_progress(console) as progress:
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
