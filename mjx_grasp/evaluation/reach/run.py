"""The reach sweep from its settings to its numbers: poses, plans, reaches (method §3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.evaluation.reach.poses import CylinderPoses, SweepConfig, draw_poses
from mjx_grasp.evaluation.reach.record import ReachRecord
from mjx_grasp.evaluation.reach.results import classify, summary
from mjx_grasp.evaluation.reach.sweep import plan_all, plan_keys, sweep
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import ReachPreset, for_sweep
from mjx_grasp.records.archive import packed, unpacked
from mjx_grasp.records.compilation import compile_seconds
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.records.spread import Spread, spread, unspread
from mjx_grasp.robot.description import RobotSpec

_ON_CPU = 128
"""Poses worked on at once."""
Told = Callable[[str, int], None]
"""Of how much more of a stage is done: `planning` in poses, `reaching` in ticks of one pose."""


@dataclass(frozen=True)
class SweepRun:
    """Everything a sweep made."""

    result: dict[str, Any]
    poses: CylinderPoses
    record: ReachRecord
    classes: np.ndarray
    """``[poses]`` failure class of each, −1 where it converged."""


@dataclass(frozen=True)
class Asked:
    """What every process that takes part in a sweep is told."""

    robot: RobotSpec
    settings: ReachPreset
    poses: int
    seed: int
    chunk: int
    """poses worked on at once"""
    bound: bool
    """whether to look for a solution where the preset does not"""


class Reached(NamedTuple):
    """What came of a share of the poses."""

    record: ReachRecord
    least_error: Float[np.ndarray, " n"] | None
    """tip error of the best posture that was found [m]"""
    seconds: dict[str, float]
    """by stage, without compilation; that apart"""

    def as_record(self) -> dict[str, Any]:
        """The same as JSON types, to the bit."""
        known = {} if self.least_error is None else {"least_error": self.least_error}
        return {"arrays": packed(self.record._asdict() | known), "seconds": self.seconds}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Reached:
        """From what `as_record` gave."""
        arrays = unpacked(record["arrays"])
        least_error = arrays.pop("least_error", None)
        return cls(ReachRecord(**arrays), least_error, record["seconds"])


class Reaching:
    """Plans and reaches for shares of a sweep's poses.

    Args:
        asked: The sweep.
        told: Of progress.
    """

    def __init__(self, asked: Asked, told: Told = lambda stage, amount: None):
        self._asked, self._told = asked, told
        self._poses = draw_poses(asked.poses, asked.seed)
        self._seconds: dict[str, float] = {}
        body, settings = robot_body(asked.robot), asked.settings
        self._reacher = Reacher(body, settings.reach, settings.selection)
        self._looks = settings.plan is not None or asked.bound
        if self._looks:
            with self._timed("planning"):
                plan = settings.plan or PlanConfig()
                self._planner = Planner(self._reacher, plan)
                self._library = start_library(body, plan)
                self._keys = plan_keys(self._planner, asked.poses)

    def share(self, rows: slice) -> Reached:
        """Reaches for some of the poses."""
        asked, on_cpu = self._asked, jax.default_backend() == "cpu"
        poses = jax.tree.map(lambda x: x[rows], self._poses)
        plans, least_error = None, None
        if self._looks:
            with self._timed("planning"):
                found = plan_all(
                    self._planner,
                    self._library,
                    poses,
                    min(asked.chunk, 32 if on_cpu else 256),
                    partial(self._told, "planning"),
                    self._keys[rows],
                )
            least_error = np.asarray(found.least_error)
            plans = found.plans if asked.settings.plan else None
        with self._timed("reaching"):
            record = sweep(
                self._reacher, poses, plans, asked.chunk, partial(self._told, "reaching")
            )
        seconds, self._seconds = self._seconds, {}
        return Reached(record, least_error, seconds)

    def share_as_record(self, rows: slice) -> dict[str, Any]:
        """The same as JSON types."""
        return self.share(rows).as_record()

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start, compiled = time.perf_counter(), compile_seconds()
        yield
        compiling = compile_seconds() - compiled
        known = self._seconds
        known[stage] = known.get(stage, 0.0) + time.perf_counter() - start - compiling
        known["compilation"] = known.get("compilation", 0.0) + compiling


@contextmanager
def journal_of(config: SweepConfig, robot: RobotSpec, console: Console) -> Iterator[Journal | None]:
    """What a stopped sweep has left beside its results file; None without such a file.

    It is gone once all is done, and stays if that is cut short.
    """
    if config.out is None:
        yield None
        return
    settings, reaches = to_record(unspread(config)), to_record(robot.identity)
    made_of = {"config": settings, "robot": reaches, "device": jax.default_backend()}
    journal = Journal(config.out, made_of, provenance(config.seed)["git"])
    if journal.done:
        console.print(f"{config.out}: goes on after {', '.join(journal.done)}")
    yield journal
    journal.close()


def run_sweep(
    robot: RobotSpec,
    settings: ReachPreset,
    count: int,
    seed: int,
    *,
    chunk: int | None = None,
    bound: bool = True,
    ends: Callable[[ReachPreset], ReachPreset] = for_sweep,
    over: Spread | None = None,
    journal: Journal | None = None,
    console: Console | None = None,
) -> SweepRun:
    """Draws the poses, plans where the preset looks ahead, reaches for all, sums up.

    Args:
        robot: What reaches.
        settings: Of the controller; a sweep's ends take the place of its own.
        count: Randomised cylinder poses.
        seed: Of the poses.
        chunk: Poses worked on at once; by default 128 on a CPU, all of them on an accelerator.
        bound: Also report the share of poses for which a solution exists at all.
        ends: Gives the settings a sweep's ends.
        over: Who shares the poses; this process alone by default. Times are those of all together.
        journal: Where what is done is kept, poses worked on at once by poses; by default nowhere.
        console: Where progress is shown; nowhere if None.

    Raises:
        InputError: A robot that the controller or its plan cannot use.
    """
    over, settings = over or Spread(), ends(settings)
    whole = over.alone and jax.default_backend() != "cpu"
    chunk = min(chunk or (count if whole else _ON_CPU), count)
    asked = Asked(robot, settings, count, seed, chunk, bound)
    size = count if over.alone and journal is None else chunk
    shares = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    control = settings.reach.controller
    ticks = round(control.timeout / control.dt)
    jobs = [(f"poses {share.start} to {share.stop}", share) for share in shares]
    kept = [share.stop - share.start for name, share in jobs if journal and name in journal.done]
    with counting_progress(console) as progress:
        if over.alone:
            looks, done = settings.plan is not None or bound, sum(kept)
            bars = {
                "planning": progress.add_task(
                    "inverse kinematics", total=count, completed=done, visible=looks
                ),
                "reaching": progress.add_task(
                    "reaching", total=count * ticks, completed=done * ticks
                ),
            }
            setup = partial(Reaching, asked, lambda at, n: progress.advance(bars[at], n))
        else:
            bar = progress.add_task(
                f"poses by {over.processes} processes", total=count, completed=sum(kept)
            )
            setup = partial(Reaching, asked)

        def show(share: slice) -> None:
            if not over.alone:  # else it has been told from within
                progress.advance(bar, share.stop - share.start)

        if journal is None:
            found = []
            for share, reached in zip(
                shares, spread(over, Reaching.share, shares, setup), strict=True
            ):
                found.append(reached)
                show(share)
        else:
            records = journaled(over, Reaching.share_as_record, jobs, setup, journal, show)
            found = [Reached.from_record(record) for record in records]
    record = jax.tree.map(lambda *parts: np.concatenate(parts), *(of.record for of in found))
    errors = [of.least_error for of in found if of.least_error is not None]
    least_error = np.concatenate(errors) if errors else None
    poses, body, limits = draw_poses(count, seed), robot_body(robot), settings.reach.limits
    result = summary(body, limits, poses, record, least_error)
    result["seconds"] = {
        stage: round(sum(of.seconds.get(stage, 0.0) for of in found), 2)
        for stage in ("planning", "reaching", "compilation")
        if any(stage in of.seconds for of in found)
    }
    return SweepRun(result, poses, record, classify(body, limits, record, least_error))
