"""The policy that a training begins with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.robot.spec import RobotSpec
from mjx_grasp.training.config import TrainConfig


def start_file(config: TrainConfig) -> Path | None:
    """Its file; None for a training that begins with nothing."""
    if config.start_from is None:
        return None
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
