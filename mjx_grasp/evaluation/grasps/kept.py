"""What is kept of whole grasps, tick by tick and of their ends."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.pipeline.state import GraspState
from mjx_grasp.tasks.success import Progress

SEGMENT = 10
"""Ticks between two looks for worlds that want new plans: the time that planning takes."""


class Trace(NamedTuple):
    """What is kept of every tick of each trial."""

    phase: Int[Array, "t w"]
    qpos: Float[Array, "t w nq"]
    rise: Float[Array, "t w"]
    """of the object origin since the start [m]"""
    object_vel: Float[Array, "t w 6"]
    """see `Truth.object_vel`"""
    tip_error: Float[Array, "t w 3"]
    """see `GraspTick.tip_error` [m]"""
    contacts: Float[Array, "t w 3 3"]
    """the three points that the hand goes for, world [m]"""
    touching: Bool[Array, "t w f"]
    """by the simulator"""
    observed: Bool[Array, "t w f"]
    """by the momentum observer, from the handoff on"""
    force: Float[Array, "t w f"]
    """on each finger, by the simulator [N]"""
    felt: Float[Array, "t w f"]
    """the same estimated from joint torques, from the handoff on [N]"""
    over: Bool[Array, "t w"]
    """whether the trial had ended before; then robot and object stay as they were"""


class GraspEnd(NamedTuple):
    """How the trials ended."""

    state: GraspState
    progress: Progress
    replans: Int[np.ndarray, " w"]
    """times that new plans were made"""
    obstacles: Float[np.ndarray, "w k 4"]
    """that hung in the way: centre and radius [m]"""
    hit: Bool[np.ndarray, " w"]
    """whether the robot touched one of them"""
    broken: Bool[np.ndarray, " w"]
    """whether its state stopped being finite; it ended with the tick before"""
    overflow_ticks: Int[np.ndarray, " w"]
    """in which a contact or constraint did not fit the engine's buffers"""


class Kept:
    """What is kept of trials that run at different times, each from its own first tick on."""

    def __init__(self, count: int, most: int):
        self.most = math.ceil(most / SEGMENT) * SEGMENT
        """ticks that a trial can have"""
        self.ticks = np.zeros(count, int)
        """that each one has had"""
        self.ended: Any = None
        """of each trial, once it has ended"""
        self._done = np.zeros(count, bool)
        self._trace: Any = None

    def add(self, at: Int[np.ndarray, " w"], ticks: Trace) -> None:
        """What happened in a segment in the worlds of these trials."""
        count, there = len(self.ticks), np.flatnonzero(at < len(self.ticks))
        if self._trace is None:
            shape = self.most, count
            self._trace = jax.tree.map(lambda x: np.empty((*shape, *x.shape[2:]), x.dtype), ticks)
        own = at[there]
        rows = self.ticks[own] + np.arange(SEGMENT)[:, None]
        for whole, some in zip(self._trace, ticks, strict=True):
            whole[rows, own] = some[:, there]
        self.ticks[own] += SEGMENT

    def end(self, trials: Int[np.ndarray, " k"], ends: Any) -> None:
        """How trials ended; their states."""
        if self.ended is None:
            count = len(self.ticks)
            self.ended = jax.tree.map(lambda x: np.empty((count, *x.shape[1:]), x.dtype), ends)
        for whole, some in zip(*map(jax.tree.leaves, (self.ended, ends)), strict=True):
            whole[trials] = some
        self._done[trials] = True

    def share(self) -> float:
        """How much is done, if all that is not over takes as long as it can."""
        return float(np.where(self._done, self.most, self.ticks).mean()) / self.most

    def trace(self) -> Trace:
        """Of all trials, as long as the longest, at the end: nothing is kept any more."""
        tick, trial = np.arange(self.ticks.max())[:, None], np.arange(self.ticks.size)
        row = np.minimum(tick, self.ticks - 1)
        leaves, padded = list(self._trace), []
        self._trace = None  # thousands of trials are gigabytes: not twice at once
        while leaves:
            padded.append(leaves.pop(0)[row, trial])
        found = Trace(*padded)
        return found._replace(over=found.over | (tick >= self.ticks))
