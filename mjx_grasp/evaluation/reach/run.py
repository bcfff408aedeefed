"""The reach sweep from its settings to its numbers: poses, plans, reaches (method §3)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.evaluation.reach.poses import CylinderPoses, draw_poses
from mjx_grasp.evaluation.reach.results import classify, summary
from mjx_grasp.evaluation.reach.sweep import ReachRecord, plan_all, sweep
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import ReachPreset, for_sweep
from mjx_grasp.records.compilation import compile_seconds
from mjx_grasp.robot.spec import RobotSpec


@dataclass(frozen=True)
class SweepRun:
    """Everything a sweep made."""

    result: dict[str, Any]
    poses: CylinderPoses
    record: ReachRecord
    classes: np.ndarray
    """``[poses]`` failure class of each, −1 where it converged."""


def run_sweep(
    robot: RobotSpec,
    settings: ReachPreset,
    count: int,
    seed: int,
    *,
    chunk: int | None = None,
    bound: bool = True,
    console: Console | None = None,
) -> SweepRun:
    """Draws the poses, plans where the preset looks ahead, reaches for all, sums up.

    Args:
        robot: What reaches.
        settings: Of the controller; a sweep's ends (:func:`for_sweep`) take the place of its own.
        count: Randomised cylinder poses.
        seed: Of the poses.
        chunk: Poses worked on at once; by default 128 on a CPU, all of them on an accelerator.
        bound: Also report the share of poses for which a solution exists at all.
        console: Where progress is shown; nowhere if None.

    Raises:
        InputError: A robot that the controller or its plan cannot use.
    """
    poses = draw_poses(count, seed)
    settings = for_sweep(settings)
    body = robot_body(robot)
    reacher = Reacher(body, settings.reach, settings.selection)
    on_cpu = jax.default_backend() == "cpu"
    chunk = min(chunk or (128 if on_cpu else count), count)
    dt, cap = settings.reach.controller.dt, settings.reach.controller.timeout
    seconds: dict[str, float] = {}
    plans, least_error = None, None
    with counting_progress(console) as progress:
        if settings.plan or bound:
            plan = settings.plan or PlanConfig()
            task = progress.add_task("library of starts", total=None)
            start, compiled = time.perf_counter(), compile_seconds()
            library = start_library(body, plan)
            progress.update(task, visible=False)
            task = progress.add_task("inverse kinematics", total=count)
            found = plan_all(
                Planner(reacher, plan),
                library,
                poses,
                min(chunk, 32) if on_cpu else min(chunk, 256),
                lambda done: progress.update(task, completed=done),
            )
            seconds["planning"] = time.perf_counter() - start - compile_seconds() + compiled
            least_error = found.least_error
            plans = found.plans if settings.plan else None
        task = progress.add_task("reaching", total=count * round(cap / dt))
        start, compiled = time.perf_counter(), compile_seconds()
        record = sweep(reacher, poses, plans, chunk, lambda ticks: progress.advance(task, ticks))
        seconds["reaching"] = time.perf_counter() - start - compile_seconds() + compiled
    limits = settings.reach.limits
    result = summary(body, limits, poses, record, least_error)
    seconds["compilation"] = compile_seconds()
    result["seconds"] = {name: round(value, 2) for name, value in seconds.items()}
    classes = classify(body, limits, record, least_error)
    return SweepRun(result, poses, record, classes)
