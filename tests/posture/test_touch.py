"""What a finger can touch from a posture: its own reach and no more, whatever the others do."""

import jax
import mujoco
import numpy as np
import pytest

from mjx_grasp.posture.touch import touch_errors
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
