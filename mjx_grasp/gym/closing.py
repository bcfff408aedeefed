"""The closing task as environments: what `train` would train on."""

from __future__ import annotations

from pathlib import Path

import gymnasium

from mjx_grasp.errors import InputError
from mjx_grasp.gym.envs import TaskEnv, TaskVectorEnv
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.shipped import shipped_for
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.tasks.assemble import build_scene_of, build_world
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.tasks.task import Task
from mjx_grasp.training.config import TrainConfig, preset_config
from mjx_grasp.training.start import handoffs_wanted


def closing_vector_env(
    num_envs: int | None = None,
    config: TrainConfig | str = "cpu",
    extra_terms: tuple[RewardTerm, ...] = (),
) -> TaskVectorEnv:
    """Many worlds of the task that `train` trains with these settings.

    Args:
        num_envs: Worlds; `config.ppo.worlds` if None.
        config: Settings of a training, or the name of a preset. What counts is what the task is
            made of: objects, robot, handoffs, engine, scene, task, noise, and whether there is a
            privileged critic. Where no handoffs are named they are those that ship for it, as for
            a training, or, where it would make its own first, the shipped ones of the eight.
        extra_terms: Reward terms beside the task's own.

    Raises:
        InputError, FileError: A setting or file that cannot work.
    """
    config = _settings(config)
    worlds = config.ppo.worlds if num_envs is None else num_envs
    return TaskVectorEnv(_task(config, worlds, extra_terms), worlds)


def closing_env(
    config: TrainConfig | str = "cpu", extra_terms: tuple[RewardTerm, ...] = ()
) -> TaskEnv:
    """One world of it; arguments as above."""
    return TaskEnv(_task(_settings(config), 1, extra_terms))


def _settings(config: TrainConfig | str) -> TrainConfig:
    return preset_config(config) if isinstance(config, str) else config


def _task(config: TrainConfig, worlds: int, extra_terms: tuple[RewardTerm, ...]) -> Task:
    if not isinstance(worlds, int) or worlds < 1:
        raise InputError("num_envs", worlds, "a whole number, 1 or more")
    robot = load_robot(config.robot)
    scene = build_scene_of(config.objects, config.objects_dir, robot, config.scene, config.weight)
    own = config.handoffs or shipped_for(handoffs_wanted(config, Path()), scene.objects)
    stored = load_handoffs(own or shipped_handoffs(config.objects_dir), robot=robot)
    names, without = eligible(scene.object_names, stored)
    if not names:
        raise InputError("objects", ", ".join(without), "objects with start states in the handoffs")
    if without:
        gymnasium.logger.warn(f"no start states, left out: {', '.join(without)}")
    world = build_world(scene, states_of(stored, names, "training"), config.task.control_dt)
    critic = config.ppo.privileged_critic
    return world.task(config.engine, worlds, config.task, config.noise, critic, extra_terms)
