"""What closing has to know of the joints that it moves; read off robot and MJCF."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_grasp.closing.config import ActionConfig
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.indices import RobotIndices, robot_indices
from mjx_grasp.robot.mjcf import robot_mjspec


class DrivenJoints(NamedTuple):
    """Which joints play which part, and constants of them. Static."""

    at: RobotIndices
    limits: Float[np.ndarray, "n 2"]
    """position limits of all joints [rad]"""
    stiffness: Float[np.ndarray, " m"]
    """position gain of the policy's finger joints [N m/rad]"""
    dry_friction: Float[np.ndarray, " g"]
    """of all joints of the three fingers, finger by finger [N m]"""
    damping: Float[np.ndarray, " g"]
    """of the same joints [N m s/rad]"""


def action_size(at: RobotIndices, config: ActionConfig) -> int:
    """With how many numbers a policy of the robot answers."""
    others = config.others * len(at.others)
    return len(at.fingers) + len(at.arm_policy) + others + config.of_grip


def driven_joints(robot: RobotSpec) -> DrivenJoints:
    """Reads the constants off the robot's compiled MJCF."""
    model, at = robot_mjspec(robot).compile(), robot_indices(robot)
    moved = [robot.joints[i] for i in at.fingers]
    dofs = [model.joint(robot.joints[i]).dofadr[0] for i in at.grasping]
    return DrivenJoints(
        at=at,
        limits=np.array([model.joint(n).range for n in robot.joints], np.float32),
        stiffness=np.array([model.actuator(n).gainprm[0] for n in moved], np.float32),
        dry_friction=model.dof_frictionloss[dofs].astype(np.float32),
        damping=model.dof_damping[dofs].astype(np.float32),
    )
