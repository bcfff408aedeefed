"""The controller of whole grasps with a policy from a file, or without one."""

from __future__ import annotations

from pathlib import Path

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.learned import LearnedPolicy
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps.config import BUDGET_N, ClosingController, check_closing
from mjx_grasp.learning.controller import check_deployable, deployed_task, load_controller
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig


def closing_policy(
    controller: ClosingController, file: Path | None, robot: RobotSpec
) -> Path | None:
    """The policy that closes: the shipped one where no other is named; None for the grip alone.

    Raises:
        InputError: A policy beside the grip alone, or none is named and the shipped one is of
            another robot.
    """
    check_closing(controller, file)
    if controller == "grip" or file is not None:
        return file
    shipped = asset_path("policy.npz")
    trained = load_policy(shipped).robot
    if not trained.agrees(robot.identity):
        expected = (
            f"{trained}, whose policy is included; for another, --policy or --controller grip"
        )
        raise InputError("--robot", str(robot.identity), expected)
    return shipped


def loaded_grasper(
    robot: RobotSpec,
    file: Path | None = None,
    budget: float = BUDGET_N,
    steered: bool = False,
    approach: Approach = "any",
) -> Grasper:
    """The controller of whole grasps; a policy closes as it does in its training.

    Args:
        robot: Arm and hand.
        file: A policy; without one the grip that answers to load closes alone.
        budget: Mean force per finger that a policy which knows a budget may take [N].
        steered: Whether scores are those of an anchor, which then has to decide.
        approach: From where the palm is to come.

    Raises:
        FileError: The policy is unreadable, of another robot or task, or reads what no robot knows.
    """
    reaching = whole_grasps(steered=steered, approach=approach)
    if file is None:
        return grasper_of(robot, reaching=reaching)
    return grasper_of(robot, *loaded_policy(robot, file, budget), reaching)


def loaded_policy(
    robot: RobotSpec, file: Path, budget: float = BUDGET_N
) -> tuple[ClosingTaskConfig, LearnedPolicy]:
    """A policy, and the settings of closing that it was trained with.

    Args:
        robot: Arm and hand.
        file: The policy.
        budget: Mean force per finger that a policy which knows a budget may take [N].

    Raises:
        FileError: The policy is unreadable, of another robot or task, or reads what no robot knows.
    """
    policy = load_controller(file, robot)
    task = deployed_task(policy)
    if isinstance(task, EndToEndConfig):
        raise FileError(file, "a policy that reaches by itself", "one of the closing task")
    check_deployable(file, task)
    return task, LearnedPolicy(policy, task.observation, budget)
