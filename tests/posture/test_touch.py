"""What a finger can touch from a posture: its own reach and no more, whatever the others do."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.posture.touch import pad_angles, pressing_force, touch_errors, touching
from mjx_grasp.robot.indices import robot_indices


@pytest.fixture(scope="module")
def errors(body):
    return jax.jit(jax.vmap(lambda q, contacts: touch_errors(body, q, contacts)))


def pads_of(body, q):
    """Where MuJoCo has the pads."""
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    found = []
    for one in q:
        data.qpos[:] = one
        mujoco.mj_kinematics(model, data)
        found.append([data.site(f.pad_site).xpos.copy() for f in body.robot.hand.fingers])
    return np.float32(found)


def folded(body, count, seed):
    """Home with the fingers' own joints somewhere within their limits."""
    rng = np.random.default_rng(seed)
    q = np.tile(body.home, (count, 1)).astype(np.float32)
    joints = robot_indices(body.robot).fingers
    low, high = body.lower[joints], body.upper[joints]
    q[:, joints] = low + rng.uniform(0.2, 0.8, (count, len(joints))) * (high - low)
    return q


def test_what_another_fold_touches_is_touched(body, errors):
    """Most of it: Gauss–Newton may end at a limit on the way."""
    start = np.tile(np.float32(body.home), (64, 1))
    found = np.asarray(errors(start, pads_of(body, folded(body, 64, 0))))
    assert np.mean(found < 1e-3) > 0.9


def test_a_pad_that_is_there_needs_no_motion(body, errors):
    q = folded(body, 8, 1)
    assert np.asarray(errors(q, pads_of(body, q))).max() < 1e-5


def test_beyond_the_reach_as_much_is_missing_at_least(body, errors):
    """A metre away at least a metre less the finger's length."""
    q = np.tile(np.float32(body.home), (1, 1))
    contacts = pads_of(body, q)
    contacts[0, 1] += [0.0, 0.0, 1.0]
    thumb, index, middle = np.asarray(errors(q, contacts))[0]
    assert index > 0.7 and max(thumb, middle) < 1e-5


def test_batched_and_looped_agree(body, errors):
    q, contacts = folded(body, 3, 2), pads_of(body, folded(body, 3, 3))
    alone = [np.asarray(touch_errors(body, *one)) for one in zip(q, contacts, strict=True)]
    np.testing.assert_allclose(np.asarray(errors(q, contacts)), alone, atol=1e-4)


def test_fingers_end_where_it_says(body, errors):
    q, contacts = folded(body, 4, 4), pads_of(body, folded(body, 4, 5))
    closed = np.asarray(jax.jit(jax.vmap(lambda *one: touching(body, *one).q))(q, contacts))
    missing = np.linalg.norm(contacts - pads_of(body, closed), axis=-1)
    np.testing.assert_allclose(missing, np.asarray(errors(q, contacts)), atol=1e-5)
    joints = robot_indices(body.robot).fingers
    np.testing.assert_array_equal(np.delete(closed, joints, 1), np.delete(q, joints, 1))


def test_what_a_finger_presses_takes_one_motor_to_its_limit(body):
    """MuJoCo turns forces on the pads into joint torques."""
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    motors = [model.actuator(name).id for name in body.robot.joints]
    limit = model.actuator_forcerange[motors, 1]
    rng = np.random.default_rng(6)
    for q in folded(body, 6, 7):
        inward = rng.normal(size=(3, 3))
        inward = np.float32(inward / np.linalg.norm(inward, axis=1, keepdims=True))
        most = np.asarray(pressing_force(body, q, jnp.asarray(inward)))
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        for k, finger in enumerate(body.robot.hand.fingers):
            site, torque = data.site(finger.pad_site), np.zeros(model.nv)
            at = model.site_bodyid[site.id]
            push = most[k] * inward[k].astype(float)
            mujoco.mj_applyFT(model, data, push, np.zeros(3), site.xpos, at, torque)
            share = np.abs(torque / limit)[~body.arm]
            assert share.max() == pytest.approx(1.0, abs=1e-3)


def test_motors_without_limits_press_as_hard_as_one_likes(body):
    free = replace(body, torque_limit=np.full_like(body.torque_limit, np.inf))
    inward = np.tile(np.float32([0, 0, 1]), (3, 1))
    assert np.isinf(pressing_force(free, body.home, jnp.asarray(inward))).all()


def test_a_pad_faces_what_its_axis_points_at_by_mujoco(body):
    """Its site's x axis points out of the finger; turned normals are off by as much."""
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    q = folded(body, 1, 3)[0]
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mats = [data.site(f.pad_site).xmat.reshape(3, 3) for f in body.robot.hand.fingers]
    for angle in (0.0, 0.4, 1.3, np.pi):
        normals = [-np.cos(angle) * m[:, 0] + np.sin(angle) * m[:, 1] for m in mats]
        found = pad_angles(body, q, jnp.asarray(np.float32(normals)))
        np.testing.assert_allclose(found, angle, atol=2e-3)
