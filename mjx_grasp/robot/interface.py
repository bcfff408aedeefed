"""A robot as controllers see it: what it measures, and the four verbs that drive it."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.errors import InputError
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.kinematics import Kinematics
from mjx_grasp.robot.mjcf import robot_mjspec


class Measured(NamedTuple):
    """What a torque-sensed robot measures, and what kinematics makes of it. World frame, SI units.

    Robot order: arm joints, then hand joints. Fingers in the order of `HandSpec.fingers`.
    """

    q: Float[Array, "*w n"]
    """joint positions [rad]"""
    qd: Float[Array, "*w n"]
    """joint velocities [rad/s]"""
    external_torque: Float[Array, "*w s g"]
    """torque on the three fingers' joints, finger by finger, that the robot's own model does not
    explain, at s equally spaced times of the last control period [N m]"""
    palm_pos: Float[Array, "*w 3"]
    """palm site [m]"""
    palm_mat: Float[Array, "*w 3 3"]
    pad_pos: Float[Array, "*w f 3"]
    """pad points [m]"""
    pad_mat: Float[Array, "*w f 3 3"]
    """pad frames; the first column is the pad's outward normal"""
    joint_axis: Float[Array, "*w n 3"]
    """unit axes of the joints"""
    joint_anchor: Float[Array, "*w n 3"]
    """a point on each joint's axis [m]"""


class Robot(Protocol):
    """What drives a robot, real or simulated; the only place where a controller meets the world.

    A control loop reads, ticks its controller and commands, once per control period::

        robot.connect()
        while True:
            state, target = controller.tick(state, robot.read(), ...)
            robot.command(target)
        robot.disconnect()
    """

    spec: RobotSpec
    control_dt: float
    """control period [s]"""

    @property
    def is_connected(self) -> bool:
        """Whether the robot can be read and commanded."""
        ...

    def connect(self) -> None:
        """Makes the robot ready, holding the posture it is in."""
        ...

    def disconnect(self) -> None:
        """Ends the connection; the robot holds its last targets or is made safe by its driver."""
        ...

    def read(self) -> Measured:
        """What is measured now; arrays without a batch dimension."""
        ...

    def command(self, target: Float[Array, " n"]) -> None:
        """Sends joint position targets for the coming control period, robot order [rad]."""
        ...


def measured_from_joints(
    kinematics: Kinematics,
    q: Float[Array, " n"],
    qd: Float[Array, " n"],
    external_torque: Float[Array, "s g"],
) -> Measured:
    """All of `Measured` from what a driver reads: joints and torques.

    Joints that move neither a pad nor the palm have no axis here: zeros.

    Args:
        kinematics: From `measuring_kinematics`.
        q: Joint positions, robot order [rad].
        qd: Joint velocities [rad/s].
        external_torque: As in `Measured` [N m].

    Raises:
        InputError: Not one position and velocity of each joint.
    """
    count = len(kinematics.joints)
    for name, found in (("q", q), ("qd", qd)):
        if jnp.shape(found) != (count,):
            expected = f"{count} numbers, one of each joint"
            raise InputError(name, f"shape {jnp.shape(found)}", expected)
    motion = kinematics.motion(q)
    axis, moment = motion.screws[:, :3], motion.screws[:, 3:]
    fingers = len(motion.pos) - 1
    return Measured(
        q=q,
        qd=qd,
        external_torque=external_torque,
        palm_pos=motion.pos[fingers],
        palm_mat=motion.mat[fingers],
        pad_pos=motion.pos[:fingers],
        pad_mat=motion.mat[:fingers],
        joint_axis=axis,
        joint_anchor=jnp.cross(axis, moment),  # of the axis, the point nearest to the origin
    )


def measuring_kinematics(robot: RobotSpec) -> Kinematics:
    """The kinematics that `measured_from_joints` needs: pads, then the palm."""
    sites = [*(finger.pad_site for finger in robot.hand.fingers), robot.hand.palm_site]
    return Kinematics.from_model(robot_mjspec(robot).compile(), sites)
