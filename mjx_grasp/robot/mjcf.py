"""The robot's MJCF as a scene builds on it: the robot alone, without floor, table and solver.

Collision bits, for a geom to choose whom it meets (two geoms meet if the contype of either is in
the conaffinity of the other):

=========  =======  ===========  ==========================================================
geoms      contype  conaffinity  meets
=========  =======  ===========  ==========================================================
hand       1        1 | 4 | 8    hand (less the excluded pairs), object, table
arm        2        4 | 8        object, table; never arm or hand
arm foot   0        4            object; its base and first link stand on the table's level
object     4        8            table, hand, arm (the last two by their own conaffinity)
table      8        0            object, hand, arm (all by their conaffinity)
=========  =======  ===========  ==========================================================

Hand against arm and arm against arm are left out: above a table the hand stays clear of the arm,
but over all joint ranges it does not (about one random configuration in ten overlaps), so whoever
folds the arm back on itself has to check this apart.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Int

from mjx_grasp.robot.spec import RobotSpec


def robot_mjspec(spec: RobotSpec) -> mujoco.MjSpec:
    """The robot's MJCF as an editable specification, for a scene to build on.

    Args:
        spec: The robot's description. Joints of the MJCF that it does not name are fixed at zero.
    """
    editable = mujoco.MjSpec.from_file(str(spec.mjcf))
    fixed = {joint.name for joint in editable.joints} - set(spec.joints)
    for actuator in list(editable.actuators):
        if actuator.target in fixed:
            editable.delete(actuator)
    for name in fixed:
        editable.delete(editable.joint(name))
    return editable


def joint_columns(spec: RobotSpec) -> Int[np.ndarray, " n"]:
    """Where the spec's joints stand among all joints of its MJCF."""
    names = [joint.name for joint in mujoco.MjSpec.from_file(str(spec.mjcf)).joints]
    return np.array([names.index(joint) for joint in spec.joints])
