"""The training loop around the iteration: progress, logs, checkpoints, guards."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column

from mjx_grasp.errors import MjxGraspError
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.checkpoint import checkpoints, save_checkpoint
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.interrupt import InterruptGuard
from mjx_grasp.learning.log import MetricLog, NoLog
from mjx_grasp.learning.ppo import TrainState, make_iteration, reward_columns
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import Count, NonNegative, Settings

COLUMNS = (
    "iteration",
    "env_steps",
    "seconds",
    "steps_per_s",
    "return",
    "success",
    "force_n",
    "reward",
    "episodes",
    "broken_worlds",
    "overflows",
    "kl_mean",
    "learning_rate",
    "policy_loss",
    "v_loss",
    "policy_dist_mean_std",
)


class TrainingDiverged(MjxGraspError):
    """What is learnt, or the loss, stopped being finite; the last good state is on disk."""


@dataclass(frozen=True)
class LoopConfig(Settings):
    """How a training is watched and kept."""

    checkpoint_every_s: NonNegative = 60.0
    """time between checkpoints; one is always written at the end [s]"""
    checkpoint_every: Count | None = None
    """iterations between checkpoints, instead of a time [-]"""
    wandb_project: str | None = None
    """Weights & Biases project; needs the extra `wandb`."""


class Member(NamedTuple):
    """One of the trainings that are trained together."""

    folder: Path
    state: TrainState
    config: dict[str, Any]
    """of the run, kept with its checkpoints"""


def train_together(
    members: Sequence[Member], env: BraxTask, ppo: PPOConfig, loop: LoopConfig
) -> list[TrainState]:
    """Runs the iterations that are left and returns the final states.

    Trainings that differ in their states alone go on in step: each learns from its own worlds,
    and the worlds of all are stepped together. Of several processes, which all run it, the first
    one writes and talks.

    Raises:
        TrainingDiverged: A NaN in a training's loss, parameters or normaliser. The state before
            it was checkpointed, the one after it is in `diverged.npz`; the others are checkpointed
            after it, so that they can go on without it.
        KeyboardInterrupt: Ctrl-C, after the iteration it came in was done and checkpointed.
    """
    devices, count = env.devices, len(members)
    step, given = make_iteration(ppo, env), 0 if devices.donates else ()
    iteration = jax.jit(step if count == 1 else jax.vmap(step), donate_argnums=given)
    start = int(members[0].state.iteration)
    columns = (*COLUMNS, *env.pace_names, *reward_columns(env.task.reward_names).values())
    logs: list[MetricLog | NoLog] = [
        MetricLog(m.folder, columns, start, loop.wandb_project, m.config)
        if devices.writes
        else NoLog()
        for m in members
    ]
    saved = time.monotonic()
    began = saved - logs[0].number_of_last("seconds")
    recent: dict[str, deque[float]] = {
        n: deque(maxlen=20 * count) for n in ("return", "success", "force_n")
    }
    counted = {"broken_worlds": 0.0, "overflows": 0.0}

    def own(tree: Any, k: int) -> Any:
        """What belongs to one training: leaves of several have one more axis in front."""
        return tree if count == 1 else jax.tree.map(lambda leaf: leaf[k], tree)

    state = members[0].state
    if count > 1:
        state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(m.state for m in members))

    def save(k: int) -> None:
        folder, _, config = members[k]
        save_checkpoint(folder / "checkpoints", own(state, k), env, config)

    with InterruptGuard() as interrupt, ExitStack() as closed, _progress(devices.writes) as shown:
        for log in logs:
            closed.enter_context(closing(log))
        task = shown.add_task("training (compiling)", total=ppo.iterations, completed=start)
        for i in range(start, ppo.iterations):
            tick = time.monotonic()
            state, metrics = iteration(state)
            found, learnt = jax.device_get((metrics, (state.params, state.normalizer)))
            now = time.monotonic()
            rows = [{n: float(x) for n, x in own(found, k).items()} for k in range(count)]
            bad = [k for k, row in enumerate(rows) if _diverged(row, own(learnt, k))]
            if bad:
                for k in range(count):
                    if k not in bad:
                        save(k)
                _stop(members[bad[0]].folder, i + 1, own(learnt, bad[0]), devices.writes)
            for k, (row, log) in enumerate(zip(rows, logs, strict=True)):
                row |= {
                    "iteration": i + 1,
                    "env_steps": (i + 1) * ppo.steps_per_iteration,
                    "seconds": now - began,
                    "steps_per_s": ppo.steps_per_iteration / (now - tick),
                }
                log.write(row)
                for name, values in recent.items():
                    if row[name] == row[name]:
                        values.append(row[name])
                for name in counted:
                    counted[name] += row[name]
                if row["broken_worlds"] and devices.writes:
                    _dump_incident(members[k].folder, own(state, k), env, i + 1)
            said = _describe(count * ppo.steps_per_iteration / (now - tick), recent, counted)
            shown.update(task, completed=i + 1, description=said)
            due, stop = devices.agreed(
                (i + 1) % loop.checkpoint_every == 0
                if loop.checkpoint_every
                else now - saved > loop.checkpoint_every_s,
                interrupt.requested,
            )
            if due or stop or i + 1 == ppo.iterations:
                for k in range(count):
                    save(k)
                saved = time.monotonic()
            if stop:
                raise KeyboardInterrupt(f"interrupted after iteration {i + 1}, which is kept")
    return [own(state, k) for k in range(count)]


def _progress(shown: bool = True) -> Progress:
    """One line; where it is narrow the bar shrinks, then the description wraps."""

    def whole() -> Column:
        return Column(no_wrap=True)

    return Progress(
        TextColumn("{task.description}", table_column=Column()),
        BarColumn(bar_width=24, table_column=Column(ratio=1)),
        MofNCompleteColumn(table_column=whole()),
        TimeElapsedColumn(table_column=whole()),
        TextColumn("left", table_column=whole()),
        TimeRemainingColumn(table_column=whole()),
        refresh_per_second=2,
        expand=True,
        disable=not shown,
    )


def _describe(
    steps_per_s: float, recent: dict[str, deque[float]], counted: dict[str, float]
) -> str:
    def mean(name: str, unit: float = 1.0, digits: int = 0) -> str:
        return f"{unit * np.mean(recent[name]):.{digits}f}" if recent[name] else "-"

    text = (
        f"{steps_per_s:,.0f} steps/s, return {mean('return')}, "
        f"success {mean('success', 100)} %, {mean('force_n', digits=1)} N"
    )
    if counted["broken_worlds"]:
        text += f", [red]{counted['broken_worlds']:.0f} worlds broken[/red]"
    if counted["overflows"]:
        text += f", [yellow]{counted['overflows']:.0f} buffer overflows[/yellow]"
    return text


def _diverged(row: dict[str, float], learnt: Any) -> bool:
    """Whether the numbers of a training are no numbers; learnt: parameters and normaliser.

    The normaliser takes in a rollout after the updates: what breaks it shows in the loss of the
    next iteration alone, when a checkpoint may hold it.
    """
    leaves = jax.tree.leaves(learnt)
    return not (np.isfinite(row["total_loss"]) and all(np.isfinite(x).all() for x in leaves))


def _stop(folder: Path, iteration: int, learnt: Any, writes: bool) -> NoReturn:
    """Stops a training that has diverged, before that reaches a checkpoint.

    Args:
        folder: Of the run.
        iteration: How many are done.
        learnt: Parameters and normaliser.
        writes: Whether this process writes files.

    Raises:
        TrainingDiverged: Always.
    """
    path = folder / "diverged.npz"
    if writes:
        _save_arrays(path, dict(zip(("params", "normalizer"), learnt, strict=True)))
    kept = checkpoints(folder / "checkpoints")
    newest = kept[-1].name if kept else "none yet"
    raise TrainingDiverged(
        f"{path}: the loss, a parameter or the normaliser is not finite at iteration {iteration}; "
        f"the newest checkpoint is {newest}: begin a new run with a lower --ppo.learning-rate "
        "(a resumed one does what this one did)"
    )


def _dump_incident(folder: Path, state: TrainState, env: BraxTask, iteration: int) -> None:
    """Writes the state from which a world stopped being finite."""
    _save_arrays(folder / f"broken_world_{iteration:08d}.npz", env.incident(state.env))


def _save_arrays(path: Path, tree: Any) -> None:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    arrays: dict[str, Any] = {jax.tree_util.keystr(p): np.asarray(x) for p, x in leaves}
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)
