"""What a driver reads becomes `Measured`: MuJoCo's own frames and Jacobians are the reference."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from six_axis import write_six_axis

from mjx_grasp.errors import InputError
from mjx_grasp.robot.indices import robot_indices
from mjx_grasp.robot.interface import measured_from_joints, measuring_kinematics
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot

POSTURES = 50


@pytest.fixture(scope="module", params=["shipped", "without idle fingers", "six axes"])
def any_robot(request, robot, tmp_path_factory):
    if request.param == "six axes":
        return load_robot(write_six_axis(tmp_path_factory.mktemp("robot")))
    return robot if request.param == "shipped" else robot.without_idle_fingers()


@pytest.fixture(scope="module")
def model(any_robot):
    return robot_mjspec(any_robot).compile()


@pytest.fixture(scope="module")
def postures(model):
    low, high = model.jnt_range.T
    return np.random.default_rng(0).uniform(low, high, (POSTURES, model.nq)).astype(np.float32)


@pytest.fixture(scope="module")
def measured(any_robot, postures):
    """All postures at once, with velocities and torques that mean nothing."""
    kinematics = measuring_kinematics(any_robot)
    rng = np.random.default_rng(1)
    torque = rng.normal(size=(POSTURES, 5, len(robot_indices(any_robot).grasping)))
    qd = jnp.asarray(rng.normal(size=postures.shape), jnp.float32)
    every = jax.jit(jax.vmap(lambda *read: measured_from_joints(kinematics, *read)))
    return jax.device_get(every(jnp.asarray(postures), qd, jnp.asarray(torque, jnp.float32)))


@pytest.fixture(scope="module")
def posed(model, postures):
    """MuJoCo's data in each posture."""

    def data_of(q):
        data = mujoco.MjData(model)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return data

    return [data_of(q) for q in postures]


def sites(robot):
    """Pads in the fingers' order, then the palm."""
    return [*(finger.pad_site for finger in robot.hand.fingers), robot.hand.palm_site]


def test_joints_are_passed_on_as_they_were_read(any_robot, measured, postures):
    np.testing.assert_array_equal(measured.q, postures)
    n, f = len(any_robot.joints), len(any_robot.hand.fingers)
    shapes = {name: x.shape[1:] for name, x in measured._asdict().items()}
    assert shapes == {
        **dict(q=(n,), qd=(n,), external_torque=(5, len(robot_indices(any_robot).grasping))),
        **dict(palm_pos=(3,), palm_mat=(3, 3), pad_pos=(f, 3), pad_mat=(f, 3, 3)),
        **dict(joint_axis=(n, 3), joint_anchor=(n, 3)),
    }


def test_the_kinematics_has_the_robots_joints_in_its_order(any_robot):
    assert measuring_kinematics(any_robot).joints == any_robot.joints


def test_frames_are_mujocos(any_robot, measured, posed):
    *pads, palm = sites(any_robot)
    for k, data in enumerate(posed):
        for f, pad in enumerate(pads):
            np.testing.assert_allclose(measured.pad_pos[k, f], data.site(pad).xpos, atol=1e-5)
            frame = data.site(pad).xmat.reshape(3, 3)
            np.testing.assert_allclose(measured.pad_mat[k, f], frame, atol=1e-5)
        np.testing.assert_allclose(measured.palm_pos[k], data.site(palm).xpos, atol=1e-5)
        frame = data.site(palm).xmat.reshape(3, 3)
        np.testing.assert_allclose(measured.palm_mat[k], frame, atol=1e-5)


def test_jacobians_of_axes_and_anchors_are_mujocos(any_robot, model, measured, posed):
    """Every joint of the arm, and of its own finger, for pads and palm."""
    at = robot_indices(any_robot)
    chains = [*at.chains, at.arm]
    expected = np.zeros((6, model.nv))
    for k, data in enumerate(posed):
        points = [*measured.pad_pos[k], measured.palm_pos[k]]
        for site, point, joints in zip(sites(any_robot), points, chains, strict=True):
            mujoco.mj_jacSite(model, data, expected[:3], expected[3:], model.site(site).id)
            axis, anchor = measured.joint_axis[k, joints], measured.joint_anchor[k, joints]
            found = np.concatenate([np.cross(axis, point - anchor), axis], axis=-1).T
            np.testing.assert_allclose(found, expected[:, joints], atol=1e-5)
            others = np.setdiff1d(np.arange(model.nv), joints)
            assert not expected[:, others].any()  # nothing else moves it


def test_axes_are_unit_vectors_through_the_joints(any_robot, model, measured, posed):
    at = robot_indices(any_robot)
    joints = np.concatenate([at.arm, at.grasping])
    for k, data in enumerate(posed):
        axis, anchor = measured.joint_axis[k, joints], measured.joint_anchor[k, joints]
        np.testing.assert_allclose(axis, data.xaxis[joints], atol=1e-5)
        beside = np.cross(anchor - data.xanchor[joints], axis)
        np.testing.assert_allclose(beside, 0.0, atol=1e-5)


def test_axes_of_joints_that_move_no_pad_are_nothing(any_robot, measured):
    """Whoever asks for them gets no velocity instead of a wrong one."""
    at = robot_indices(any_robot)
    idle = ~at.mask(np.concatenate([at.arm, at.grasping]))
    assert idle.any() == (any_robot.name == "rizon4_hx5d20" and len(any_robot.joints) == 27)
    assert not measured.joint_axis[:, idle].any() and not measured.joint_anchor[:, idle].any()


@pytest.mark.wrong_types
def test_readings_of_another_number_of_joints_are_refused(robot):
    kinematics, n = measuring_kinematics(robot), len(robot.joints)
    right, torque = np.zeros(n, np.float32), np.zeros((5, 9), np.float32)
    for name, q, qd in (("q", right[1:], right), ("qd", right, right[1:])):
        with pytest.raises(InputError, match=rf"^{name}: .* expected {n} numbers"):
            measured_from_joints(kinematics, q, qd, torque)


def test_a_driver_measures_what_the_simulator_reports(robot, starts):
    """The same state, once from the engine's data and once from its joints."""
    kinematics, seen = measuring_kinematics(robot), starts.measured
    at = robot_indices(robot)
    joints = np.concatenate([at.arm, at.grasping])
    for row in (0, 4, 8):
        known = (x[row] for x in (seen.q, seen.qd, seen.external_torque))
        found = measured_from_joints(kinematics, *known)
        for name in ("palm_pos", "palm_mat", "pad_pos", "pad_mat"):
            np.testing.assert_allclose(
                getattr(found, name), getattr(seen, name)[row], atol=1e-5, err_msg=name
            )
        np.testing.assert_allclose(
            found.joint_axis[joints], seen.joint_axis[row, joints], atol=1e-5
        )
