"""The robot's MJCF as a scene builds on it: the robot alone, without floor, table and solver.

Which geoms collide, and by which bits, is said in ``assets/robot/rizon4_hx5d20_facts.yaml``.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Int

from mjx_grasp.robot.description import RobotSpec


def robot_mjspec(spec: RobotSpec) -> mujoco.MjSpec:
    """The robot's MJCF as an editable specification, for a scene to build on.

    Args:
        spec: The robot's description. Joints of the MJCF that it does not name are fixed at zero;
            the table top is at z = 0.
    """
    editable = mujoco.MjSpec.from_file(str(spec.mjcf))
    fixed = {joint.name for joint in editable.joints} - set(spec.joints)
    for actuator in list(editable.actuators):
        if actuator.target in fixed:
            editable.delete(actuator)
    for name in fixed:
        editable.delete(editable.joint(name))
    for base in editable.worldbody.bodies:
        base.pos[2] += spec.base_height
    return editable


def joint_columns(spec: RobotSpec) -> Int[np.ndarray, " n"]:
    """Where the spec's joints stand among all joints of its MJCF."""
    names = [joint.name for joint in mujoco.MjSpec.from_file(str(spec.mjcf)).joints]
    return np.array([names.index(joint) for joint in spec.joints])
