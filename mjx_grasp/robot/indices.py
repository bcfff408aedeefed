"""Which joints play which part, as indices into robot order: the arm's joints, then the hand's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from mjx_grasp.errors import InputError
from mjx_grasp.robot.description import RobotSpec


@dataclass(frozen=True, eq=False)
class RobotIndices:
    """The joints of a robot by their parts; fingers are those of the grasp, in their order."""

    joints: tuple[str, ...]
    """names in robot order"""
    arm: Int[np.ndarray, " a"]
    """the arm's joints"""
    arm_policy: Int[np.ndarray, " p"]
    """those of them that the policy moves"""
    finger_joints: tuple[Int[np.ndarray, " _"], ...]
    """all joints of each finger, from its root"""
    finger_policy: tuple[Int[np.ndarray, " _"], ...]
    """those of them that the policy moves"""

    @property
    def grasping(self) -> Int[np.ndarray, " g"]:
        """All joints of the three fingers, finger by finger."""
        return np.concatenate(self.finger_joints)

    @property
    def grasping_per_finger(self) -> Int[np.ndarray, "f k"]:
        """The same, a row for each finger.

        Raises:
            InputError: The fingers have different numbers of joints.
        """
        return _stacked("hand.fingers.joints", self.finger_joints)

    @property
    def fingers(self) -> Int[np.ndarray, " m"]:
        """The policy's finger joints, finger by finger."""
        return np.concatenate(self.finger_policy)

    @property
    def per_finger(self) -> Int[np.ndarray, "f m"]:
        """The same, a row for each finger.

        Raises:
            InputError: The fingers have different numbers of them.
        """
        return _stacked("hand.fingers.policy_joints", self.finger_policy)

    @property
    def other_arm(self) -> Int[np.ndarray, " p"]:
        """Joints of the arm that the policy does not move when it closes."""
        return np.setdiff1d(self.arm, self.arm_policy)

    @property
    def other_fingers(self) -> Int[np.ndarray, " q"]:
        """Joints of the three fingers that it does not."""
        return np.setdiff1d(self.grasping, self.fingers)

    @property
    def others(self) -> Int[np.ndarray, " o"]:
        """Both: the arm's, then the fingers'."""
        return np.concatenate([self.other_arm, self.other_fingers])

    @property
    def chains(self) -> Int[np.ndarray, "f c"]:
        """All joints that move each pad: the arm's, then the finger's.

        Raises:
            InputError: The fingers have different numbers of joints.
        """
        return _stacked(
            "hand.fingers.joints", [np.concatenate([self.arm, f]) for f in self.finger_joints]
        )

    def mask(self, indices: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " joints"]:
        """Whether each joint is among these."""
        return np.isin(np.arange(len(self.joints)), indices)


def robot_indices(robot: RobotSpec) -> RobotIndices:
    """Works out the parts of a robot's joints from its description alone."""
    place = {name: i for i, name in enumerate(robot.joints)}

    def of(names: Sequence[str]) -> Int[np.ndarray, " n"]:
        return np.array([place[name] for name in names], dtype=int)

    fingers = robot.hand.fingers
    return RobotIndices(
        joints=robot.joints,
        arm=of(robot.arm.joints),
        arm_policy=of(robot.arm.policy_joints),
        finger_joints=tuple(of(finger.joints) for finger in fingers),
        finger_policy=tuple(of(finger.policy_joints) for finger in fingers),
    )


def _stacked(field: str, rows: Sequence[Int[np.ndarray, " _"]]) -> Int[np.ndarray, "f n"]:
    counts = {len(row) for row in rows}
    if len(counts) > 1:
        raise InputError(field, [len(row) for row in rows], "as many joints in every finger")
    return np.stack(rows)
