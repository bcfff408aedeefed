"""Worlds of a task with episodes that end, each with a stream of random numbers of its own."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.tasks.starts import StartDraw
from mjx_grasp.tasks.task import Observations, Task, TaskState


class WorldsState(NamedTuple):
    """All worlds at one tick."""

    task: TaskState
    obs: Observations
    keys: Array
    """one per world, for its next start"""
    age: Int[Array, " w"]
    """ticks of the episode so far"""


class Ticked(NamedTuple):
    """What a tick yields."""

    reward: Float[Array, " w"]
    terminated: Bool[Array, " w"]
    """whether a world stopped being finite, or its episode has failed already"""
    truncated: Bool[Array, " w"]
    """whether the time is up"""


class Worlds:
    """A task's worlds, each as if it were alone: seeds and episodes are its own.

    Args:
        task: The task.
    """

    def __init__(self, task: Task):
        self.task = task
        self.start, self.tick = jax.jit(self._start), jax.jit(self._tick)
        self.renew, self.info = jax.jit(self._renew), jax.jit(self._info)

    def _start(self, keys: Array) -> WorldsState:
        keys, draw = self._draw(keys)
        state, obs = self.task.start(draw)
        worlds = WorldsState(state, obs, keys, jnp.zeros(len(keys), jnp.int32))
        # Of the types that a tick returns, or the first tick would be compiled twice.
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), worlds)

    def _tick(self, worlds: WorldsState, action: Float[Array, "w k"]) -> tuple[WorldsState, Ticked]:
        state, tick = self.task.tick(worlds.task, action)
        age = worlds.age + 1
        # A broken world is last seen as it was before: no observation may hold what is no number.
        obs = {
            name: jnp.where(tick.broken[:, None], worlds.obs[name], seen)
            for name, seen in tick.obs.items()
        }
        reward = sum(tick.rewards.values(), start=jnp.zeros(len(age)))
        ended = tick.broken | tick.over
        truncated = (age >= self.task.episode_ticks) & ~ended
        return WorldsState(state, obs, worlds.keys, age), Ticked(reward, ended, truncated)

    def _renew(self, worlds: WorldsState, mask: Bool[Array, " w"]) -> WorldsState:
        """Begins new episodes in the masked worlds."""
        keys, draw = self._draw(worlds.keys)
        keys = jnp.where(mask[:, None], keys, worlds.keys)
        state, obs = self.task.reset(worlds.task, mask, draw)
        return WorldsState(state, obs, keys, jnp.where(mask, 0, worlds.age))

    def _info(self, worlds: WorldsState) -> dict[str, Array]:
        """What has come of each episode so far; forces in N, the rise in m."""
        summary = self.task.summary(worlds.task)
        names = ("success", "lifting", "force_mean", "force_peak", "peak_rise")
        return {name: jnp.nan_to_num(getattr(summary, name)) for name in names}

    def _draw(self, keys: Array) -> tuple[Array, StartDraw]:
        """Keys for later, and a start of each world."""
        later, now = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
        single = jax.vmap(lambda key: self.task.draw(key, 1))(now)
        draw: Any = jax.tree.map(lambda x: x[:, 0], single)
        return later, draw
