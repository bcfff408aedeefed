"""A training run: start states, PPO, policy, evaluation, in a folder that it can resume from."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
from rich.console import Console

from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.shipped import shipped_for
from mjx_grasp.handoff.states import eligible, states_of, with_states
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.checkpoint import newest_checkpoint, restore_checkpoint
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.devices import Devices, check_even, find_devices
from mjx_grasp.learning.log import require_wandb
from mjx_grasp.learning.memory import device_memory, worlds_that_fit
from mjx_grasp.learning.policy import Policy, policy_from_training
from mjx_grasp.learning.ppo import TrainState, init_state
from mjx_grasp.learning.run import Member, train_together
from mjx_grasp.learning.warm_start import begin_from
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.identity import RobotIdentity
from mjx_grasp.sim.physics import check_control_rate
from mjx_grasp.sim.scene import Scene
from mjx_grasp.tasks.assemble import World, build_scene_of, build_world
from mjx_grasp.tasks.end_to_end import EndToEndTask
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.training.after import evaluate_run
from mjx_grasp.training.config import TrainConfig
from mjx_grasp.training.folder import (
    as_begun,
    check_same_files,
    check_same_terms,
    discard_run,
    note_resumed,
    open_run,
    run_folder,
)
from mjx_grasp.training.start import given_to, handoffs_wanted, made_handoffs, trainable


def run_training(
    config: TrainConfig,
    console: Console,
    extra_terms: tuple[RewardTerm, ...] = (),
    command: str | None = None,
) -> Path:
    """Runs a training to its end and returns the run's folder.

    Of several processes, which all call this, the first one writes and evaluates.

    Args:
        config: The settings.
        console: For progress and tables.
        extra_terms: Reward terms beside the task's own.
        command: What its files say they were made by; by default what started this process.

    Raises:
        InputError, FileError: A setting or file that cannot work; no folder is made then.
        KeyboardInterrupt: Ctrl-C; its message says how to continue, once there is a run.
    """
    (folder,) = run_together([config], console, extra_terms, [command])
    return folder


def run_together(
    configs: Sequence[TrainConfig],
    console: Console,
    extra_terms: tuple[RewardTerm, ...] = (),
    commands: Sequence[str | None] | None = None,
) -> list[Path]:
    """Runs trainings that differ in their seed alone, in step, and returns their folders.

    Each learns from worlds of its own, and the worlds of all are stepped together: where one has
    too few to fill a GPU, several take hardly longer. Those that are resumed have to stand at the
    same iteration.

    Args:
        configs: The settings; several have to name --handoffs, and folders of their own.
        console: For progress and tables.
        extra_terms: Reward terms beside the task's own.
        commands: What the files of each say they were made by; by default what started this
            process.

    Raises:
        InputError, FileError: A setting or file that cannot work; no folder is made then.
        KeyboardInterrupt: Ctrl-C; its message says how to continue, once there are runs.
    """
    first = configs[0]
    require_wandb(first.loop.wandb_project)
    devices = find_devices(first.run_on)
    if not first.fit_memory:
        check_even(first.ppo.worlds, first.ppo.minibatches, devices)
    _check_alike(configs, devices)
    for config in configs:
        _check_shared_by_processes(config)
    folders = [run_folder(config) for config in configs]
    console = console if devices.writes else Console(quiet=True)
    resumed = _to_resume(configs)
    robot, start, stored = given_to(first)
    for config in configs:
        check_same_files(config)
        check_same_terms(config, extra_terms)
    scene = build_scene_of(first.objects, first.objects_dir, robot, first.scene, first.weight)
    check_control_rate(scene, first.task.control_dt)
    fitting = _fit_worlds(first, scene, devices, len(configs))
    configs = [replace(config, ppo=fitting, fit_memory=False) for config in configs]
    world = None if stored is None else _build(scene, stored, first, console)
    wanted = handoffs_wanted(first, folders[0])
    shipped = shipped_for(wanted, scene.objects) if stored is None else None
    shipped = as_begun(first, shipped)
    devices.wait("every process has looked at the folder")
    told = commands or [None] * len(configs)

    def open_all() -> None:
        """Opens new runs, and notes in others what goes on with them: all, or none is new."""
        opened = []
        try:
            for config, folder, command in zip(configs, folders, told, strict=True):
                if config.resume is None:
                    open_run(config, folder, stored, shipped, command, extra_terms)
                    opened.append(folder)
                else:
                    note_resumed(folder, provenance(config.seed, command))
        except BaseException:
            for folder in opened:
                discard_run(folder)
            raise

    _first_alone(devices, open_all)
    try:
        if stored is None or world is None:
            try:
                stored = made_handoffs(wanted, shipped, robot, console)
            except MjxGraspError:
                if first.resume is None:
                    discard_run(folders[0])
                raise
            world = _build(scene, stored, first, console)
        runs = [
            Opened(folder, config, begin or start, command)
            for folder, config, begin, command in zip(folders, configs, resumed, told, strict=True)
        ]
        _run(runs, devices, world, stored, console, extra_terms)
    except KeyboardInterrupt as interrupt:
        said = str(interrupt) or "interrupted"
        again = "; ".join(
            f"python -m mjx_grasp.train --resume {shlex.quote(str(folder))}" for folder in folders
        )
        if extra_terms:
            again = f"the script that gave the extra terms, with resume={str(folders[0])!r}"
        raise KeyboardInterrupt(f"{said}; continue with: {again}") from None
    return folders


def _first_alone(devices: Devices, work: Callable[[], None]) -> None:
    """Work of the first process, without which none goes on.

    Raises:
        MjxGraspError: It failed in the first process, which raises what came of it.
    """
    problem: BaseException | None = None
    if devices.writes:
        try:
            work()
        except BaseException as error:  # told once the others know
            problem = error
    (failed,) = devices.agreed(problem is not None)
    if problem is not None:
        raise problem
    if failed:
        raise MjxGraspError("the first process cannot begin and says why")


class Opened(NamedTuple):
    """A training whose folder is there."""

    folder: Path
    config: TrainConfig
    begin: Path | Policy | None
    """what it begins with: a checkpoint, a policy or nothing"""
    command: str | None


def _check_alike(configs: Sequence[TrainConfig], devices: Devices) -> None:
    """Refuses several trainings that cannot go on in step.

    Raises:
        InputError: They differ in more than their seed and folder, make their start states
            themselves, or would be on several devices.
    """
    first = configs[0]
    if len(configs) == 1:
        return
    for config in configs:
        if replace(config, seed=first.seed, out=first.out, resume=first.resume) != first:
            found = f"settings of {config.resume or config.out} that differ from the others'"
            raise InputError("configs", found, "one setting, several seeds")
    folders = {config.resume or config.out for config in configs}
    if None in folders or len(folders) < len(configs):
        raise InputError("--out", "the same for several trainings", "a folder for each")
    if first.handoffs is None:
        raise InputError("--handoffs", "nothing", "start states that several trainings share")
    if first.loop.wandb_project is not None:
        expected = "nothing: a process has one run of Weights & Biases"
        raise InputError("--loop.wandb-project", first.loop.wandb_project, expected)
    if devices.count > 1:
        raise InputError("--devices", devices.count, "one for trainings that go on in step")


def _to_resume(configs: Sequence[TrainConfig]) -> list[Path | None]:
    """The checkpoint from which each goes on, if it is resumed and has one.

    Raises:
        FileError: They stand at different iterations.
    """
    found = [
        newest_checkpoint(config.resume / "checkpoints") if config.resume else None
        for config in configs
    ]
    first = found[0]
    for config, path in zip(configs, found, strict=True):
        if (path and path.name) != (first and first.name):
            stands = path.name if path else "no checkpoint"
            expected = f"{first.name if first else 'none'}, as {configs[0].resume} has"
            raise FileError(config.resume or Path("runs"), stands, expected)
    return found


def _run(
    runs: Sequence[Opened],
    devices: Devices,
    world: World,
    handoffs: HandoffSet,
    console: Console,
    extra_terms: tuple[RewardTerm, ...],
) -> None:
    """Trains in opened runs, keeps the policies and evaluates them."""
    config = runs[0].config
    ppo = config.ppo
    names, _ = eligible(world.scene.object_names, handoffs)
    worlds = ppo.worlds // devices.count
    task = world.task(
        config.engine, worlds, config.task, config.noise, ppo.privileged_critic, extra_terms
    )
    if isinstance(task, EndToEndTask):
        way = task.way
        console.print(
            f"{way.blocked} of {way.nearest.size} postures between handoffs and home touch "
            "something: the nearest that touch nothing stand for them"
        )
    env = BraxTask(task, worlds, ppo.stagger, devices)
    spread = f" on {devices.count} devices" if devices.count > 1 else ""
    times = "" if len(runs) == 1 else f"{len(runs)} trainings of "
    console.print(
        f"preset {config.preset}: {len(names)} object(s), {times}{ppo.worlds} worlds in "
        f"{config.engine}{spread}, {ppo.iterations} iterations of {ppo.steps_per_iteration:,} "
        f"steps → {', '.join(str(run.folder) for run in runs)}"
    )
    members = []
    for run in runs:
        state = init_state(ppo, env, run.config.seed)
        if isinstance(run.begin, Path):
            state, goes_on = restore_checkpoint(run.begin, state, env)
            fresh = "" if goes_on else ", with fresh worlds: those of its version were others"
            console.print(f"resumed from {run.begin.name}{fresh}")
        elif run.begin is not None:
            console.print(f"begins with a policy: {config.start_from}")
            state = begin_from(run.begin, ppo, env, state)
        members.append(Member(run.folder, state, to_record(run.config)))
    states = train_together(members, env, ppo, config.loop)
    writes = devices.writes
    if writes:
        for run, state in zip(runs, states, strict=True):
            _save_policy(run.folder, state, run.config, names, world.scene.robot.identity)
    devices.part()
    if writes and config.evaluation_episodes:
        _, _, held_out = with_states(names, handoffs, "evaluation")
        for run in runs:
            evaluate_run(run.folder, run.config, world, held_out, console, run.command)


def _build(scene: Scene, handoffs: HandoffSet, config: TrainConfig, console: Console) -> World:
    """The scene with the training's share of the start states."""
    names, without = trainable(scene.object_names, handoffs)
    if without:
        console.print(f"[yellow]not eligible, left out: {', '.join(without)}[/yellow]")
    judged, unjudged, _ = with_states(names, handoffs, "evaluation")
    if config.evaluation_episodes and not judged:
        expected = "0, as no object has a start state beside those of the training"
        raise InputError("--evaluation-episodes", config.evaluation_episodes, expected)
    if config.evaluation_episodes and unjudged:
        few = "without start states beside those of the training, not evaluated"
        console.print(f"[yellow]{few}: {', '.join(unjudged)}[/yellow]")
    return build_world(scene, states_of(handoffs, names, "training"), config.task.control_dt)


def _check_shared_by_processes(config: TrainConfig) -> None:
    """Refuses what each of several processes would choose or make for itself.

    Raises:
        InputError: No folder is named, or no start states.
    """
    if jax.process_count() == 1 or config.resume is not None:
        return
    for flag, given in (("--out", config.out), ("--handoffs", config.handoffs)):
        if given is None:
            raise InputError(flag, "nothing", "a path that all processes see")


def _fit_worlds(
    config: TrainConfig, scene: Scene, devices: Devices, trainings: int = 1
) -> PPOConfig:
    if not config.fit_memory:
        return config.ppo
    room = device_memory() // trainings
    worlds = worlds_that_fit(scene, config.ppo, room, devices.count)
    return replace(config.ppo, worlds=worlds)


def _save_policy(
    folder: Path,
    state: TrainState,
    config: TrainConfig,
    names: list[str],
    robot: RobotIdentity,
) -> None:
    meta = {
        "task": to_record(config.task),
        "noise": to_record(config.noise),
        "objects": names,
        "env_steps": int(state.iteration) * config.ppo.steps_per_iteration,
        "provenance": read_json(folder / "provenance.json", "the provenance of the run"),
    }
    policy = policy_from_training(state.policy, state.normalizer, meta, robot)
    policy.save(folder / "policy.npz")
