"""Which number of an observation or an action is what, for whoever fills them elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mjx_grasp.closing.learned import FORCE_UNIT
from mjx_grasp.records.settings import NonNegative, Settings, WholeNumber
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.indices import robot_indices
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig


@dataclass(frozen=True)
class Segment(Settings):
    """Numbers that stand side by side."""

    what: str
    start: WholeNumber
    """index of the first of them"""
    of: tuple[str, ...]
    """the joint, finger or part of each, in their order"""
    unit: str
    one: NonNegative
    """what the number 1 stands for, in that unit"""
    ticks_ago: WholeNumber | None = None
    """of how many control ticks ago they are; none where that means nothing"""

    @property
    def stop(self) -> int:
        """Index after the last of them."""
        return self.start + len(self.of)


def observation_layout(robot: RobotSpec, config: ClosingTaskConfig) -> tuple[Segment, ...]:
    """The parts of what a policy of the task reads, in their order.

    Args:
        robot: Whose joints and fingers they are of.
        config: The task.
    """
    seen, joints = config.observation, robot.hand.policy_joints
    fingers = tuple(finger.name for finger in robot.hand.fingers)
    actions = tuple(name for part in action_layout(robot, config) for name in part.of)
    step = [
        ("joint_position", joints, "rad", 1.0),
        ("joint_velocity", joints, "rad/s", 1.0),
        ("last_action", actions, "-", 1.0),
    ]
    if seen.forces:
        step += [
            ("pressing_force", fingers, "N", FORCE_UNIT),
            ("sliding_force", fingers, "N", FORCE_UNIT),
            ("grip_force", ("grip",), "N", FORCE_UNIT),
        ]
    along = tuple(f"{finger}.{axis}" for finger in fingers for axis in "xyz")
    if seen.targets:
        step.append(("target", along, "m", 1.0))
    if seen.normals:
        step.append(("target_normal", along, "-", 1.0))
    if seen.arm:
        step.append(("arm_position", robot.arm.joints, "rad", 1.0))
    if seen.others:
        arms, hands = _others(robot)
        step.append(("other_position", (*arms, *hands), "rad", 1.0))
    parts: list[_Part] = [(*part, ago) for ago in reversed(seen.ticks_ago) for part in step]
    if seen.budget:
        parts.append(("force_budget", ("grip",), "N", FORCE_UNIT, None))
    return _side_by_side(parts)


def action_layout(robot: RobotSpec, config: ClosingTaskConfig) -> tuple[Segment, ...]:
    """The parts of what it answers, each number from −1 to 1; arguments as above."""
    action, arm = config.action, config.action.arm_rate
    if isinstance(config, EndToEndConfig) and config.reach_rate is not None:
        arm = config.reach_rate  # before the lift, where nearly all of the way is
    parts: list[_Part] = [
        ("finger_residual", robot.hand.policy_joints, "rad/s", action.finger_rate, None),
        ("arm_residual", robot.arm.policy_joints, "rad/s", arm, None),
    ]
    if action.others:
        arms, hands = _others(robot)
        parts.append(("other_arm_joint", arms, "rad/s", arm, None))
        parts.append(("other_finger_joint", hands, "rad/s", action.finger_rate, None))
    if action.of_grip:
        factor = "factor, its inverse at -1"
        parts.append(("grip_force", ("grip",), factor, action.grip_range, None))
    return _side_by_side(parts)


def _others(robot: RobotSpec) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Joints that closing leaves alone, of the arm and of the fingers."""
    at = robot_indices(robot)
    return (
        tuple(robot.joints[i] for i in at.other_arm),
        tuple(robot.joints[i] for i in at.other_fingers),
    )


_Part = tuple[str, tuple[str, ...], str, float, int | None]


def _side_by_side(parts: Iterable[_Part]) -> tuple[Segment, ...]:
    found, start = [], 0
    for what, of, unit, one, ago in parts:
        found.append(Segment(what, start, of, unit, one, ago))
        start += len(of)
    return tuple(found)
