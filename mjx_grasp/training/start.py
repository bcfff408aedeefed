"""What a training begins with: its robot, start states and a policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import eligible
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.objects.catalogue import find_objects, load_catalogue, resolve
from mjx_grasp.objects.meshes import find_scan
from mjx_grasp.records.atomic import copy_file
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.training.config import TrainConfig

START = "start.npz"
"""The policy that a run began with, in its folder."""


def handoffs_wanted(config: TrainConfig, folder: Path) -> HandoffConfig:
    """The set of start states that is made in a run's folder where none is given or shipped."""
    return HandoffConfig(
        objects=config.objects,
        objects_dir=config.objects_dir,
        mass=config.mass,
        density=config.density,
        robot=config.robot,
        per_object=config.handoffs_per_object,
        kind=config.handoffs_kind,
        gate=config.handoffs_gate,
        seed=config.seed,
        out=folder / "handoffs.npz",
    )


def start_file(config: TrainConfig) -> Path | None:
    """Its file, of a run that is resumed its own copy; None where it begins with nothing."""
    if config.start_from is None:
        return None
    if config.resume is not None and (config.resume / START).is_file():
        return config.resume / START
    return asset_path("policy.npz") if config.start_from == "shipped" else Path(config.start_from)


def start_policy(config: TrainConfig, robot: RobotSpec) -> Policy | None:
    """The policy, which has to see, do and be built as the training's does.

    Raises:
        FileError: It cannot be read, or belongs to another robot or task.
        InputError: It sees, does or is built otherwise.
    """
    path = start_file(config)
    if path is None:
        return None
    try:
        policy = load_controller(path, robot)
    except FileError as error:
        expected = f"{error.expected}; --start-from None begins with nothing"
        raise FileError(error.path, error.found, expected) from None
    its, own = policy_task(policy), config.task
    # How it is held to its budget changes what one number says, not which numbers there are.
    seen = replace(its.observation, keeping=own.observation.keeping)
    hidden = tuple(weight.shape[1] for weight in policy.weights[:-1])
    for name, there, here in (
        ("task", type(its).__name__, type(own).__name__),
        ("task.observation", seen, own.observation),
        ("task.action", its.action, own.action),
        ("ppo.hidden", hidden, config.ppo.hidden),
    ):
        if there != here:
            expected = f"a policy with {name} = {here}, as this training; or None"
            raise InputError("--start-from", f"{path} with {name} = {there}", expected)
    return policy


class Given(NamedTuple):
    """What a training is begun with."""

    robot: RobotSpec
    start: Policy | None
    """the policy that it begins with"""
    handoffs: HandoffSet | None
    """its start states, where they are not made first"""


def given_to(config: TrainConfig) -> Given:
    """What a configuration names, looked at: what cannot work is refused in less than a second.

    Raises:
        InputError, FileError: A robot, policy, scan or start states that cannot be had or do not
            belong together.
    """
    robot = load_robot(config.robot)
    start = start_policy(config, robot)
    for each in find_objects(config.objects):
        if config.objects_dir is not None and each.file is None:
            find_scan(config.objects_dir, load_catalogue()[each.name].scan_names)
    stored = None if config.handoffs is None else load_handoffs(config.handoffs, robot=robot)
    if stored is not None:
        trainable(resolve(config.objects), stored)
    return Given(robot, start, stored)


def trainable(names: Sequence[str], handoffs: HandoffSet) -> tuple[list[str], list[str]]:
    """Splits objects into those with start states and those without.

    Args:
        names: Of the objects.
        handoffs: The start states.

    Raises:
        InputError: None has any.
    """
    have, without = eligible(names, handoffs)
    if not have:
        counts = handoffs.counts()
        known = ", ".join(n for n in counts if counts[n]) or "none"
        raise InputError("--objects", ", ".join(names), f"objects with pre-grasps ({known})")
    return have, without


def made_handoffs(
    wanted: HandoffConfig, shipped: Path | None, robot: RobotSpec, console: Console
) -> HandoffSet:
    """The set in the run's folder; if it is not there yet, a copy of the shipped one, or made.

    Args:
        wanted: From `handoffs_wanted`.
        shipped: The shipped set that would do, if there is one.
        robot: Whose states they are.
        console: For what is done, and its progress.

    Raises:
        FileError: The set cannot be read, or is another robot's.
        MjxGraspError: It cannot be made.
    """
    path = wanted.out
    if path.exists():
        return load_handoffs(path, robot=robot)
    if shipped is not None:
        console.print(f"start states: {shipped.name}, which ships with the package")
        copy_file(shipped, path)
    else:
        from mjx_grasp.handoff.make import make_handoffs

        console.print("making handoff states (give --handoffs to use a stored set)")
        make_handoffs(wanted, console)
    return load_handoffs(path, robot=robot)
