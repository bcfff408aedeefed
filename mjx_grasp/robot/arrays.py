"""Arm and grasping hand as arrays: what inverse kinematics of three fingertips needs of a robot."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.robot.kinematics import Kinematics
from mjx_grasp.robot.spec import RobotSpec
from mjx_grasp.robot.spheres import HandSpheres, hand_spheres, sphere_arms

# Of the frames: three tips, three pads and the palm come before the bodies with spheres.
_FIRST_BODY = 7


class RobotArrays(NamedTuple):
    """What the solver needs of a robot, in the robot's joint order.

    Attributes:
        kinematics: Frames: the three tips, the three pads, the palm, then the bodies that carry
            the spheres.
        palm: The palm's frame alone, for draws of the arm.
        lower, upper: ``[joints]`` position limits in [rad].
        nominal: ``[joints]`` home with the hand open, [rad].
        solved: ``[joints]`` whether a joint is solved for; the others stay nominal.
        arm: ``[joints]`` whether a joint is the arm's.
        approach_axis: ``[3]`` the palm's approach direction in its frame.
        spheres: The hand's shape; its frames count from the first sphere body.
    """

    kinematics: Kinematics
    palm: Kinematics
    lower: np.ndarray
    upper: np.ndarray
    nominal: np.ndarray
    solved: np.ndarray
    arm: np.ndarray
    approach_axis: np.ndarray
    spheres: HandSpheres

    def sphere_centres(
        self, pos: Float[Array, "frames 3"], mat: Float[Array, "frames 3 3"]
    ) -> Float[Array, "s 3"]:
        """Where the hand's spheres are in world, [m].

        Args:
            pos: Origins of the frames of the kinematics, [m].
            mat: Their rotations.
        """
        arms = sphere_arms(self.spheres, mat[_FIRST_BODY:])
        return pos[self.spheres.frame + _FIRST_BODY] + arms


def robot_arrays(robot: RobotSpec) -> RobotArrays:
    """Limits, postures, shape and kinematics of arm and hand, from the robot's MJCF."""
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    fingers = robot.hand.fingers
    sites = [f.tip_site for f in fingers] + [f.pad_site for f in fingers]
    bodies = [robot.hand.palm_body, *(body for f in fingers for body in f.bodies)]
    joints = [model.joint(name) for name in robot.joints]
    driven = set(robot.arm.joints).union(*(f.joints for f in fingers))
    addresses = np.array([int(j.qposadr[0]) for j in joints])
    return RobotArrays(
        kinematics=Kinematics.from_model(model, [*sites, robot.hand.palm_site], bodies),
        palm=Kinematics.from_model(model, [robot.hand.palm_site]),
        lower=np.array([j.range[0] for j in joints]),
        upper=np.array([j.range[1] for j in joints]),
        nominal=np.array(robot.home),
        solved=np.array([name in driven for name in robot.joints]),
        arm=np.array([name in robot.arm.joints for name in robot.joints]),
        approach_axis=np.array(robot.hand.approach_axis),
        spheres=hand_spheres(model, robot, addresses, bodies),
    )
