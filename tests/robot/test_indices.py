from dataclasses import replace

import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.robot.indices import robot_indices


def names(robot, indices):
    return tuple(robot.joints[i] for i in indices)


def test_every_part_has_its_joints(robot):
    indices, hand = robot_indices(robot), robot.hand
    assert indices.joints == robot.joints
    assert names(robot, indices.arm) == robot.arm.joints
    assert names(robot, indices.arm_policy) == robot.arm.policy_joints
    assert names(robot, indices.fingers) == hand.policy_joints
    assert names(robot, indices.grasping) == tuple(j for f in hand.fingers for j in f.joints)
    for row, chain, finger in zip(indices.per_finger, indices.chains, hand.fingers, strict=True):
        assert names(robot, row) == finger.policy_joints
        assert names(robot, chain) == robot.arm.joints + finger.joints


def test_without_idle_fingers_names_stay(robot):
    fewer = robot.without_idle_fingers()
    assert names(fewer, robot_indices(fewer).fingers) == robot.hand.policy_joints


def test_what_the_policy_leaves_alone_are_the_others_of_arm_and_fingers(robot):
    indices = robot_indices(robot)
    moved = {*names(robot, indices.arm_policy), *names(robot, indices.fingers)}
    both = (*robot.arm.joints, *(j for f in robot.hand.fingers for j in f.joints))
    expected = [joint for joint in robot.joints if joint in both and joint not in moved]
    assert list(names(robot, indices.others)) == expected and expected


def test_masks(robot):
    indices = robot_indices(robot)
    mask = indices.mask(indices.arm)
    np.testing.assert_array_equal(mask, [j in robot.arm.joints for j in robot.joints])


def test_fingers_of_different_lengths_have_no_table(robot):
    thumb, first, second = robot.hand.fingers
    short = replace(second, joints=second.joints[1:], policy_joints=second.policy_joints[1:])
    indices = robot_indices(replace(robot, hand=replace(robot.hand, fingers=(thumb, first, short))))
    assert len(indices.grasping) == len(robot_indices(robot).grasping) - 1
    for part, field in (("per_finger", "policy_joints"), ("chains", "fingers")):
        with pytest.raises(InputError, match=field):
            getattr(indices, part)
