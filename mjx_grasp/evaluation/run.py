"""An evaluation from its configuration to its rows: start states, trials, sums, warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Shaped
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.closing.config import GripConfig
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import OUTCOMES, ResultRow
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.evaluation.trials import (
    Trials,
    by_object,
    force_apart,
    incidents,
    joined_draws,
    paired_draws,
    room_for,
    run_trials,
    zero_controller,
)
from mjx_grasp.handoff.dataset import HandoffSet, kind_of
from mjx_grasp.handoff.states import states_of, with_states
from mjx_grasp.learning.controller import deployed_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.records.provenance import usable_cores
from mjx_grasp.sim.engines import WORLDS, Engine
from mjx_grasp.tasks.assemble import TaskConfig, World
from mjx_grasp.tasks.config import MAX_ANGLE_RAD, RewardConfig, StartNoise
from mjx_grasp.tasks.success import FAILURES
from mjx_grasp.tasks.task import Task

_UNPAID = RewardConfig(reach=0.0)
"""One that no task refuses."""


def chosen_states(
    stored: HandoffSet, config: EvaluateConfig
) -> tuple[list[str], list[str], HandoffSet]:
    """The objects that can be evaluated, those that cannot, and the former's states.

    Raises:
        InputError: An unknown object, or none with states in the part of the set.
    """
    asked = resolve(config.objects)
    names, without, states = with_states(asked, stored, config.states)
    if not names:
        counts = states_of(stored, stored.object_names, config.states).counts()
        known = ", ".join(n for n in counts if counts[n]) or "none"
        expected = f"objects with start states ({known}); --handoffs takes others"
        raise InputError("--objects", ", ".join(asked), expected)
    return names, without, states


class Evaluated(NamedTuple):
    """What came of an evaluation."""

    rows: list[ResultRow]
    """one per object"""
    trials: dict[str, Trials]
    """of each of them"""


def evaluate(
    world: World,
    names: Sequence[str],
    config: EvaluateConfig,
    policy: Policy | None,
    reached: Bool[np.ndarray, " n"],
    console: Console,
    task: TaskConfig | None = None,
) -> Evaluated:
    """Runs the trials of each object, sums them up and warns of what the engine could not do.

    Args:
        world: Scene and start states.
        names: Objects, all of them with start states.
        config: Controller, engine and condition.
        policy: The policy, for the controller `policy`.
        reached: Which of the world's start states are ends of reaches, for the rows.
        console: Where the progress bar and warnings go.
        task: Whose lift and times squeeze and grip have; by default the closing task's. A policy is
            always in the task it was trained in, but for how it is held to its budget.
    """
    return evaluate_beside(world, names, [config], policy, reached, console, task)[0]


def evaluate_beside(
    world: World,
    names: Sequence[str],
    configs: Sequence[EvaluateConfig],
    policy: Policy | None,
    reached: Bool[np.ndarray, " n"],
    console: Console,
    task: TaskConfig | None = None,
    room: int = 1,
) -> list[Evaluated]:
    """Evaluations beside each other, which in MJX share batches.

    A GPU takes hardly less time for few worlds than for many.

    Args:
        world: As of `evaluate`, like all that follow.
        names: Objects.
        configs: Of one controller, engine and number of trials; only what each trial draws may
            differ, and forces that a grip keeps.
        policy: The policy.
        reached: Which start states are ends of reaches.
        console: Where the progress bar and warnings go.
        task: Whose lift and times squeeze and grip have.
        room: For so many evaluations batches have room, if there are fewer: batches of one size are
            compiled once.

    Raises:
        ValueError: They differ in more than that.
    """
    first = configs[0]
    tasks = [_task_of(config, policy, task) for config in configs]
    shared, forces = zip(*map(force_apart, tasks), strict=True)
    each = zip(configs, shared, strict=True)
    alike = {(c.controller, c.engine, c.episodes, c.worlds, c.robot_errors, own) for c, own in each}
    if len(alike) > 1:
        raise ValueError("evaluations that share no task cannot be beside each other")
    # Trials are drawn below, with a force that the grip keeps. A task itself uses the robot's
    # errors, and whether objects are turned.
    turned = any(config.noise.angle_rad for config in configs)
    felt = StartNoise(angle_rad=MAX_ANGLE_RAD if turned else 0.0, robot=first.noise.robot)
    # Native MuJoCo steps the worlds of one object in threads; a GPU takes all that have room.
    most, episodes = first.worlds or WORLDS[first.engine], first.episodes
    together = room_for(first.engine, episodes, first.worlds)
    asked = [(k, name) for k in range(len(configs)) for name in names]
    wanted = max(len(configs), room) * len(names)
    worlds = min(most, episodes * min(together, wanted))
    run = _task(world, first.engine, worlds, shared[0], felt)
    controller = policy.controller() if policy else zero_controller(run)
    found = [Evaluated([], {}) for _ in configs]
    with counting_progress(console) as bar:
        threads = f", {usable_cores()} threads" if first.engine == "mujoco" else ""
        what = f"{first.controller} in {first.engine}{threads}"
        job = bar.add_task(what, total=len(asked))
        for begin in range(0, len(asked), together):
            beside = asked[begin : begin + together]
            draws = []
            for k, name in beside:
                drawn = episodes, configs[k].noise, configs[k].seed, forces[k]
                draws.append(paired_draws(world.starts, [world.scene.object_index(name)], *drawn))
            ran = run_trials(run, controller, joined_draws(draws), worlds)
            for (k, name), own in zip(beside, by_object(ran, len(beside)), strict=True):
                found[k].trials[name] = own
                found[k].rows.append(summarise(name, own, configs[k], reached, tasks[k]))
                _warn(name, own, console)
            bar.update(job, advance=len(beside))
    return found


def _task_of(config: EvaluateConfig, policy: Policy | None, task: TaskConfig | None) -> TaskConfig:
    own = deployed_task(policy, config.keeping_gain) if policy else None
    # Nobody is paid here: policies that were trained by other rewards alone are compiled once.
    return replace(own or model_based(task or TaskConfig(), config), reward=_UNPAID)


@lru_cache(maxsize=1)
def _task(world: World, engine: Engine, worlds: int, config: TaskConfig, noise: StartNoise) -> Task:
    """The task of an evaluation; the next one's is the same if it differs in its draws alone."""
    return world.task(engine, worlds, config, noise, with_privileged=False)


def model_based(task: TaskConfig, config: EvaluateConfig) -> TaskConfig:
    """The task with the grip of a controller that no policy adds to: a squeeze's, or `grip`."""
    if config.controller == "grip":
        return replace(task, grip=config.grip)
    plain = GripConfig()
    squeeze = replace(
        task.grip,
        force=config.squeeze_force,
        split=config.squeeze_split,
        direction=plain.direction,
        follow=plain.follow,
        settles=plain.settles,
        friction=plain.friction,
    )
    return replace(task, grip=squeeze)


def outcome_letters(trials: Trials) -> Shaped[np.ndarray, " n"]:
    """What came of each trial, as a letter of `OUTCOMES`."""
    letters = np.full(len(trials.success), OUTCOMES["successes"])
    for failure in FAILURES:
        letters[getattr(trials, failure)] = OUTCOMES[failure]
    return letters


def summarise(
    name: str,
    trials: Trials,
    config: EvaluateConfig,
    reached: Bool[np.ndarray, " n"],
    task: TaskConfig,
) -> ResultRow:
    """One row of a results file."""
    n, successes = len(trials.success), int(trials.success.sum())
    # What a broken world says of its forces may be no number.
    lifted = np.isfinite(trials.force_mean) & np.isfinite(trials.force_peak)
    peaks = trials.force_peak[lifted]
    held = trials.force_held[trials.success & np.isfinite(trials.force_held)]
    squeeze, grip = config.controller == "squeeze", config.controller == "grip"
    knows_budget = config.controller == "policy" and task.observation.budget
    failures = {failure: getattr(trials, failure) for failure in FAILURES}
    letters = outcome_letters(trials)
    return ResultRow(
        object=name,
        controller=config.controller,
        engine=config.engine,
        episodes=n,
        successes=successes,
        **{failure: int(happened.sum()) for failure, happened in failures.items()},
        ci95=wilson_interval(successes, n),
        force_mean_n=float(trials.force_mean[lifted].mean()) if lifted.any() else None,
        force_peak_n=float(peaks.max()) if lifted.any() else None,
        squeeze_force_n=config.squeeze_force if squeeze else None,
        offset_mm=config.offset_mm,
        angle_deg=config.angle_deg,
        friction=config.friction,
        handoffs=kind_of(reached),
        outcomes="".join(letters),
        force_held_n=float(held.mean()) if len(held) else None,
        force_peak_p50_n=float(np.median(peaks)) if lifted.any() else None,
        force_peak_p99_n=float(np.quantile(peaks, 0.99)) if lifted.any() else None,
        forces_n=tuple(
            round(force, 3) if math.isfinite(force) else None
            for force in trials.force_mean.tolist()
        ),
        starts=tuple(trials.row.tolist()),
        squeeze_split=config.squeeze_split if squeeze else None,
        grip_force_n=config.grip.force if grip else None,
        grip_friction=config.grip.friction if grip else None,
        mass_scale=config.mass_scale,
        force_budget_n=config.force_budget if knows_budget else None,
        keeping_gain=task.observation.keeping.gain if knows_budget else None,
        robot_errors=config.robot_errors,
        label=None,
        friction_spread=config.friction_spread,
        reached_share=float(reached[trials.row].mean()),
    )


def _warn(name: str, trials: Trials, console: Console) -> None:
    """Says which trials cannot be trusted: contacts were left out, or the numbers were none."""
    counted, n = incidents([trials]), len(trials.success)
    if counted["overflows"]:
        hit = int((trials.overflow_ticks > 0).sum())
        console.print(
            f"[yellow]{name}: {counted['overflows']} buffer overflows in {hit} of {n} trials; "
            "contacts were left out[/yellow]"
        )
    if counted["broken_worlds"]:
        console.print(
            f"[yellow]{name}: {counted['broken_worlds']} of {n} worlds broken; "
            "their states stopped being finite[/yellow]"
        )
