"""The training loop around the iteration: progress, logs, checkpoints, guards."""

from __future__ import annotations

import time
from collections import deque
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
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
    """The loss or the parameters stopped being finite; the last good state is on disk."""


@dataclass(frozen=True)
class LoopConfig(Settings):
    """How a training is watched and kept."""

    checkpoint_every_s: NonNegative = 60.0
    """time between checkpoints; one is always written at the end [s]"""
    checkpoint_every: Count | None = None
    """iterations between checkpoints, instead of a time [-]"""
    wandb_project: str | None = None
    """Weights & Biases project; needs the extra `wandb`."""


def train_loop(
    folder: Path,
    state: TrainState,
    env: BraxTask,
    ppo: PPOConfig,
    loop: LoopConfig,
    run_config: dict[str, Any],
) -> TrainState:
    """Runs the iterations that are left and returns the final state.

    Of several processes, which all run it, the first one writes and talks.

    Raises:
        TrainingDiverged: A NaN in loss or parameters. The state before it was checkpointed, the
            one after it is in `diverged.npz`.
        KeyboardInterrupt: Ctrl-C, after the iteration it came in was done and checkpointed.
    """
    devices = env.devices
    given = 0 if devices.donates else ()
    iteration = jax.jit(make_iteration(ppo, env), donate_argnums=given)
    start = int(state.iteration)
    columns = (*COLUMNS, *env.pace_names, *reward_columns(env.task.reward_names).values())
    log: MetricLog | NoLog = (
        MetricLog(folder, columns, start, loop.wandb_project, run_config)
        if devices.writes
        else NoLog()
    )
    saved = time.monotonic()
    began = saved - log.number_of_last("seconds")
    recent: dict[str, deque[float]] = {
        n: deque(maxlen=20) for n in ("return", "success", "force_n")
    }
    counted = {"broken_worlds": 0.0, "overflows": 0.0}
    with InterruptGuard() as interrupt, closing(log), _progress(devices.writes) as progress:
        task = progress.add_task("training (compiling)", total=ppo.iterations, completed=start)
        for i in range(start, ppo.iterations):
            tick = time.monotonic()
            state, metrics = iteration(state)
            row = {name: float(x) for name, x in jax.device_get(metrics).items()}
            now = time.monotonic()
            _guard(folder, state, row, devices.writes)
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
                _dump_incident(folder, state, env, i + 1)
            progress.update(task, completed=i + 1, description=_describe(row, recent, counted))
            due, stop = devices.agreed(
                (i + 1) % loop.checkpoint_every == 0
                if loop.checkpoint_every
                else now - saved > loop.checkpoint_every_s,
                interrupt.requested,
            )
            if due or stop or i + 1 == ppo.iterations:
                save_checkpoint(folder / "checkpoints", state, env, run_config)
                saved = time.monotonic()
            if stop:
                raise KeyboardInterrupt(f"interrupted after iteration {i + 1}, which is kept")
    return state


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
    row: dict[str, float], recent: dict[str, deque[float]], counted: dict[str, float]
) -> str:
    def mean(name: str, unit: float = 1.0, digits: int = 0) -> str:
        return f"{unit * np.mean(recent[name]):.{digits}f}" if recent[name] else "-"

    text = (
        f"{row['steps_per_s']:,.0f} steps/s, return {mean('return')}, "
        f"success {mean('success', 100)} %, {mean('force_n', digits=1)} N"
    )
    if counted["broken_worlds"]:
        text += f", [red]{counted['broken_worlds']:.0f} worlds broken[/red]"
    if counted["overflows"]:
        text += f", [yellow]{counted['overflows']:.0f} buffer overflows[/yellow]"
    return text


def _guard(folder: Path, state: TrainState, row: dict[str, float], writes: bool) -> None:
    """Stops a training whose numbers are no numbers, before they reach a checkpoint.

    Raises:
        TrainingDiverged: The loss or a parameter is not finite.
    """
    leaves = jax.tree.leaves(state.params)
    finite = np.isfinite(row["total_loss"]) and all(
        np.isfinite(x).all() for x in map(np.asarray, leaves)
    )
    if finite:
        return
    path = folder / "diverged.npz"
    if writes:
        _save_arrays(path, {"params": state.params, "normalizer": state.normalizer})
    kept = checkpoints(folder / "checkpoints")
    newest = kept[-1].name if kept else "none yet"
    raise TrainingDiverged(
        f"{path}: the loss or a parameter is not finite at iteration {int(state.iteration)}; "
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
