"""A policy file as the controller of a robot: that both fit, and in which task it was trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mjx_grasp.closing.learned import KEEPING
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.policy import Policy, load_policy
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.identity import check_robot
from mjx_grasp.tasks.assemble import TaskConfig
from mjx_grasp.tasks.observation import policy_sizes
from mjx_grasp.tasks.record import task_from_record


def load_controller(path: Path, robot: RobotSpec) -> Policy:
    """Reads a policy of a robot, of a task that is known here.

    Raises:
        FileError: It is unreadable, or of another robot or task.
    """
    policy = load_policy(path)
    check_robot(path, policy.robot, robot.identity)
    try:
        policy_task(policy)
    except InputError as error:
        raise FileError(path, f"{error.field} = {error.found!r}", error.expected) from None
    sizes, fitting = (
        (policy.observation_size, policy.action_size),
        policy_sizes(robot, policy_task(policy)),
    )
    if sizes != fitting:
        names = "observation_size, action_size = "
        raise FileError(path, f"{names}{sizes}", f"{fitting}, those of the robot")
    return policy


def check_deployable(path: Path, task: TaskConfig) -> None:
    """Refuses a policy that reads what no robot knows.

    Raises:
        FileError: It was trained with `observation.truth`.
    """
    if task.observation.truth:
        found = "a policy that reads what only a simulator knows (observation.truth)"
        raise FileError(path, found, "one that reads what a robot measures")


def deployed_task(policy: Policy, keeping_gain: float = KEEPING.gain) -> TaskConfig:
    """The task of a policy at work: as it was trained in, but held to its force budget.

    What it is told of that stays within the budgets of its training, where its file says them.

    Args:
        policy: The policy.
        keeping_gain: How fast the budget that it is told follows what it spares or spends too much;
            0: it is told its own [1/s].

    Raises:
        InputError: A field of the task is unknown or has an impossible value.
    """
    task = policy_task(policy)
    least, most = policy.meta.get("noise", {}).get("budget_n", (KEEPING.least, KEEPING.most))
    keeping = replace(KEEPING, gain=keeping_gain, least=least, most=most)
    return replace(task, observation=replace(task.observation, keeping=keeping))


def policy_task(policy: Policy) -> TaskConfig:
    """The task a policy was trained in, as its file says.

    Raises:
        InputError: A field is unknown or has an impossible value.
    """
    return task_from_record(policy.meta.get("task"))
