"""Trials: whole episodes without resets, paired between controllers by the seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.config import StartNoise
from mjx_grasp.errors import InputError
from mjx_grasp.tasks.closing import ClosingEnv, EnvState
from mjx_grasp.tasks.starts import StartDraw, StartTable, draw_starts
from mjx_grasp.tasks.success import failure_classes

Controller = Callable[[dict[str, Array]], Float[Array, "w a"]]
"""Observations in, actions out."""

Column = Array | np.ndarray
"""On the device while trials run, on the host once they are done."""


class Trials(NamedTuple):
    """What came of each trial."""

    row: Int[Column, " n"]
    """Row of the start table."""
    success: Bool[Column, " n"]
    never_lifted: Bool[Column, " n"]
    slipped: Bool[Column, " n"]
    not_held: Bool[Column, " n"]
    broken: Bool[Column, " n"]
    """The state stopped being finite; counted as never lifted or not held as it was."""
    overflow_ticks: Int[Column, " n"]
    """Control ticks in which a contact or constraint did not fit the engine's buffers."""
    force_mean: Float[Column, " n"]
    """Finger force, mean over fingers and ticks since lift onset [N]; nan without a lift."""
    force_peak: Float[Column, " n"]
    """Largest force on one finger since lift onset [N]; nan without a lift."""
    peak_rise: Float[Column, " n"]
    """Largest rise of the object [m]."""
    reward: Float[Column, " n"]
    """Sum of rewards."""


def zero_controller(env: ClosingEnv) -> Controller:
    """The model-based command alone: with `grip_force` F this is the squeeze baseline."""
    return lambda obs: jnp.zeros((obs["state"].shape[0], env.action_size))


def paired_draws(
    starts: StartTable, object_index: int, episodes: int, noise: StartNoise, seed: int
) -> StartDraw:
    """Starts of one object, the same for every controller with the same seed.

    Every handoff of the object is used once before any is used twice.

    Raises:
        InputError: The table has no start of this object.
    """
    rows = np.flatnonzero(np.asarray(starts.object_index) == object_index)
    if len(rows) == 0:
        raise InputError("objects", f"index {object_index}", "an object with start states")
    key = jax.random.fold_in(jax.random.PRNGKey(seed), object_index)
    order = np.random.default_rng((seed, object_index)).permutation(len(rows))
    picked = rows[order[np.arange(episodes) % len(rows)]]
    draw = draw_starts(key, episodes, starts, noise, jnp.ones(len(starts.object_index)))
    return draw._replace(row=jnp.asarray(picked))


def run_trials(env: ClosingEnv, controller: Controller, draw: StartDraw, worlds: int) -> Trials:
    """Runs one episode per row of `draw`, `worlds` at a time.

    Args:
        env: The task on an engine.
        controller: The controller.
        draw: Starts.
        worlds: Worlds per batch; an MJX engine's own number.
    """
    count = len(draw.row)
    batch = jax.jit(lambda d: _episode(env, controller, d))
    parts = []
    for first in range(0, count, worlds):
        index = np.minimum(np.arange(first, first + worlds), count - 1)
        part = batch(StartDraw(*(x[index] for x in draw)))
        parts.append(Trials(*(np.asarray(x)[: count - first] for x in part)))
    return Trials(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def record_trials(
    env: ClosingEnv, controller: Controller, draw: StartDraw
) -> tuple[Trials, Float[np.ndarray, "t w nq"]]:
    """The same, with the positions of every tick, for pictures."""

    def run(d: StartDraw) -> tuple[Trials, Array]:
        def tick(carry, _):
            state, obs = carry
            state, out = env.tick(state, controller(obs))
            qpos = env.physics.pack(state.physics)["qpos"]
            return (state, out.obs), (qpos, out.broken, state.readings.overflow)

        (state, _), (qpos, broken, overflow) = jax.lax.scan(
            tick, env.start(d), length=env.config.episode_ticks
        )
        return _trials(env, state, broken, overflow), qpos

    trials, qpos = jax.jit(run)(draw)
    return jax.tree.map(np.asarray, trials), np.asarray(qpos)


def incidents(runs: Iterable[Trials]) -> dict[str, int]:
    """What went wrong in the engine: `overflows` [control ticks] and `broken_worlds`, in all."""
    runs = tuple(runs)
    return {
        "overflows": sum(int(run.overflow_ticks.sum()) for run in runs),
        "broken_worlds": sum(int(run.broken.sum()) for run in runs),
    }


def _episode(env: ClosingEnv, controller: Controller, draw: StartDraw) -> Trials:
    def tick(carry: tuple[EnvState, dict[str, Array]], _: None):
        state, obs = carry
        state, out = env.tick(state, controller(obs))
        return (state, out.obs), (out.broken, state.readings.overflow)

    (state, _), seen = jax.lax.scan(tick, env.start(draw), length=env.config.episode_ticks)
    return _trials(env, state, *seen)


def _trials(
    env: ClosingEnv, state: EnvState, broken: Bool[Array, "t n"], overflow: Bool[Array, "t n"]
) -> Trials:
    """Sums up the last state, and what every tick told of the engine."""
    episode = state.episode
    lift_ticks = episode.lift_tick + 1  # the onset's own tick counts
    return Trials(
        row=episode.row,
        success=episode.outcome.success,
        **failure_classes(episode.outcome),
        broken=broken.any(axis=0),
        overflow_ticks=overflow.sum(axis=0),
        force_mean=jnp.where(episode.lifting, episode.force_sum / lift_ticks, jnp.nan),
        force_peak=jnp.where(episode.lifting, episode.force_peak, jnp.nan),
        peak_rise=episode.outcome.peak_rise,
        reward=episode.total_reward,
    )
