"""What a training begins with: start states and a policy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.robot.spec import RobotSpec
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
