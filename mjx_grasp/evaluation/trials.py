"""Trials: whole episodes without resets, paired between controllers by the seed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.config import GripConfig
from mjx_grasp.errors import InputError
from mjx_grasp.sim.engines import WORLDS, Engine
from mjx_grasp.tasks.assemble import TaskConfig
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.tasks.starts import StartDraw, StartTable, draw_starts
from mjx_grasp.tasks.task import Observations, Task, TaskState

Item = TypeVar("Item")
Controller = Callable[[Observations], Float[Array, "w a"]]
"""Observations in, actions out."""

Told = tuple[tuple[Any, ...], dict[str, Any]]
"""Arguments and named arguments of a controller, before the observations."""

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
    force_held: Float[Column, " n"]
    """The same mean over the ticks in which the object is held off the table [N]; nan without."""
    peak_rise: Float[Column, " n"]
    """Largest rise of the object [m]."""
    reward: Float[Column, " n"]
    """Sum of rewards."""


def zero_controller(task: Task) -> Controller:
    """The task's own command alone: in the closing task the squeeze, with its `grip.force`."""
    return Partial(_always, jnp.zeros(task.action_size))


def _always(action: Float[Array, " a"], obs: Observations) -> Float[Array, "w a"]:
    return jnp.broadcast_to(action, (len(obs["state"]), len(action)))


def force_apart(task: TaskConfig) -> tuple[TaskConfig, float | None]:
    """A grip's force apart from its task, if the grip keeps it: one task for all forces.

    Args:
        task: With a grip.

    Returns:
        The task that grips of other forces have too, and the force for `paired_draws` [N]; None if
        the grip answers to its load.
    """
    if task.grip.friction is not None:
        return task, None
    return replace(task, grip=replace(task.grip, force=GripConfig().force)), task.grip.force


def paired_draws(
    starts: StartTable,
    objects: Sequence[int],
    episodes: int,
    noise: StartNoise,
    seed: int,
    force: float | None = None,
) -> StartDraw:
    """Starts of objects, one after the other, the same for every controller with the same seed.

    Every handoff of an object is used once before any is used twice.

    Args:
        starts: Of all objects.
        objects: Their indices in the scene.
        episodes: Of each object.
        noise: What is drawn.
        seed: Of the draws. Those of an object are the same from the same states in the same place
            among the scene's objects.
        force: With which every grip begins; None: with that of its settings [N].

    Raises:
        InputError: The table has no start of an object.
    """
    draws = [_draws_of(starts, index, episodes, noise, seed) for index in objects]
    draw = joined_draws(draws)
    return draw if force is None else draw._replace(force=jnp.full(len(draw.row), force))


def joined_draws(draws: Sequence[StartDraw]) -> StartDraw:
    """Starts one after the other."""
    together: StartDraw = jax.tree.map(lambda *parts: jnp.concatenate(parts), *draws)
    return together


def _draws_of(
    starts: StartTable, object_index: int, episodes: int, noise: StartNoise, seed: int
) -> StartDraw:
    rows = np.flatnonzero(np.asarray(starts.object_index) == object_index)
    if len(rows) == 0:
        raise InputError("objects", f"index {object_index}", "an object with start states")
    key = jax.random.fold_in(jax.random.PRNGKey(seed), object_index)
    order = np.random.default_rng((seed, object_index)).permutation(len(rows))
    picked = rows[order[np.arange(episodes) % len(rows)]]
    draw = draw_starts(key, episodes, noise, jnp.ones(len(starts.object_index)))
    return draw._replace(row=jnp.asarray(picked))


def room_for(engine: Engine, trials: int, worlds: int | None = None) -> int:
    """How many conditions have room in one batch: one in native MuJoCo, which gains nothing by it.

    Args:
        engine: What steps the physics.
        trials: Of a condition.
        worlds: Of a batch; None: the engine's own number.
    """
    return max(1, (worlds or WORLDS[engine]) // trials) if engine == "mjx" else 1


def evenly(items: Sequence[Item], most: int) -> list[Sequence[Item]]:
    """Items in parts of at most so many, as even as can be; none has more than the first."""
    count = -(-len(items) // most)
    of = [len(items) // count + (k < len(items) % count) for k in range(count)]
    return [items[end - n : end] for n, end in zip(of, accumulate(of), strict=True)]


def by_object(trials: Trials, count: int) -> list[Trials]:
    """Trials of as many objects apart, of each as many as of the others, as they were drawn."""
    apart = (np.split(np.asarray(part), count) for part in trials)
    return [Trials(*parts) for parts in zip(*apart, strict=True)]


def run_trials(task: Task, controller: Controller, draw: StartDraw, worlds: int) -> Trials:
    """Runs one episode per row of `draw`, `worlds` at a time.

    Args:
        task: On an engine.
        controller: The controller. Of two `jax.tree_util.Partial` of the same function, one after
            the other on the same task, the second is not compiled again; their arguments are
            arrays.
        draw: Starts.
        worlds: Worlds per batch; an MJX engine's own number.
    """
    known: Any = task  # mypy does not know that a task has a hash
    act: Callable = controller
    told: Told = (), {}
    if isinstance(controller, Partial):
        act, told = controller.func, (controller.args, controller.keywords)
    count, batch = len(draw.row), _compiled(known, act)
    parts = []
    for first in range(0, count, worlds):
        index = np.minimum(np.arange(first, first + worlds), count - 1)
        part = batch(told, jax.tree.map(lambda x, rows=index: x[rows], draw))
        parts.append(Trials(*(np.asarray(x)[: count - first] for x in part)))
    return Trials(*(np.concatenate(p) for p in zip(*parts, strict=True)))


@functools.lru_cache(maxsize=1)
def _compiled(task: Task, act: Callable) -> Callable[[Told, StartDraw], Trials]:
    """Episodes of a task; what is asked for again, for another object or policy, is compiled once.

    Args:
        task: On an engine.
        act: The controller, before the arguments that the compiled function is given for it.
    """

    def episodes(told: Told, draw: StartDraw) -> Trials:
        args, keywords = told
        controller = functools.partial(act, *args, **keywords)
        return _episode(task, controller, draw, lambda state: ())[0]

    return jax.jit(episodes)


def record_trials(
    task: Task, controller: Controller, draw: StartDraw
) -> tuple[Trials, Float[np.ndarray, "t w nq"]]:
    """The same, with the positions of every tick, for pictures."""

    def positions(state: TaskState) -> Float[Array, "w nq"]:
        return task.snapshot(state)["qpos"]

    return watch_trials(task, controller, draw, positions)


def watch_trials(
    task: Task, controller: Controller, draw: StartDraw, look: Callable[[TaskState], Any]
) -> tuple[Trials, Any]:
    """Runs all trials at once and keeps what `look` sees of the state after every tick.

    Args:
        task: On an engine.
        controller: The controller.
        draw: Starts.
        look: From a state to arrays, worlds first; ticks come before them in what is returned.
    """
    return jax.tree.map(np.asarray, jax.jit(lambda d: _episode(task, controller, d, look))(draw))


def incidents(runs: Iterable[Trials]) -> dict[str, int]:
    """What went wrong in the engine: `overflows` [control ticks] and `broken_worlds`, in all."""
    runs = tuple(runs)
    return {
        "overflows": sum(int(run.overflow_ticks.sum()) for run in runs),
        "broken_worlds": sum(int(run.broken.sum()) for run in runs),
    }


def _episode(
    task: Task, controller: Controller, draw: StartDraw, look: Callable[[TaskState], Any]
) -> tuple[Trials, Any]:
    """One episode of all worlds, and what `look` saw after each tick."""

    def tick(carry: tuple[TaskState, Observations, Array], _: None) -> tuple[Any, Any]:
        state, obs, total = carry
        state, out = task.tick(state, controller(obs))
        total = total + sum(out.rewards.values(), start=jnp.zeros_like(total))
        return (state, out.obs, total), (out.broken, out.overflow, look(state))

    begun = (*task.start(draw), jnp.zeros(len(draw.row)))
    (state, _, total), (broken, overflow, seen) = jax.lax.scan(
        tick, begun, length=task.episode_ticks
    )
    summary = task.summary(state)
    return Trials(
        row=summary.row,
        success=summary.success,
        never_lifted=summary.never_lifted,
        slipped=summary.slipped,
        not_held=summary.not_held,
        broken=broken.any(axis=0),
        overflow_ticks=overflow.sum(axis=0),
        force_mean=jnp.where(summary.lifting, summary.force_mean, jnp.nan),
        force_peak=jnp.where(summary.lifting, summary.force_peak, jnp.nan),
        force_held=summary.force_held,
        peak_rise=summary.peak_rise,
        reward=total,
    ), seen
