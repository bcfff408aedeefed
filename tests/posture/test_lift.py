"""The lift from a posture: straight where joints have room, short where one is at its limit."""

import jax
import numpy as np
import pytest

from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.robot.indices import robot_indices

HEIGHT = 0.15


@pytest.fixture(scope="module")
def lift(body):
    return jax.jit(jax.vmap(lambda q: scripted_lift(body, q, HEIGHT)))


def drawn(body, count, seed):
    """Postures around home, the hand where it was."""
    rng = np.random.default_rng(seed)
    q = np.tile(body.home, (count, 1))
    q[:, body.arm] += rng.uniform(-0.5, 0.5, (count, int(body.arm.sum())))
    return np.clip(q, body.lower, body.upper).astype(np.float32)


def test_from_home_the_palm_rises_straight(body, lift):
    found = lift(np.float32(body.home)[None])
    assert found.rise[0] == pytest.approx(HEIGHT, abs=5e-3)
    assert found.error[0] < 6e-3


def test_a_joint_at_its_limit_keeps_the_palm_back(body, lift):
    moving = robot_indices(body.robot).arm_policy
    q = np.tile(np.float32(body.home), (2 * len(moving), 1))
    for k, joint in enumerate(moving):
        q[2 * k, joint], q[2 * k + 1, joint] = body.lower[joint], body.upper[joint]
    error = np.asarray(lift(q).error)
    assert error.max() > 0.05


def test_the_error_is_what_the_rise_lacks_and_the_drift(body, lift):
    found = lift(drawn(body, 64, 0))
    rise, error = np.asarray(found.rise), np.asarray(found.error)
    assert np.all(np.isfinite(error)) and np.all(error >= np.abs(HEIGHT - rise) - 1e-6)


def test_no_height_no_motion(body):
    found = scripted_lift(body, np.float32(body.home), 0.0)
    assert found.rise == found.error == 0.0


def test_batched_and_looped_agree(body, lift):
    q = drawn(body, 3, 1)
    together = np.asarray(lift(q).error)
    alone = [float(scripted_lift(body, one, HEIGHT).error) for one in q]
    assert np.allclose(together, alone, atol=1e-4)
