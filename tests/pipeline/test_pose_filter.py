"""The filter of object poses: laws, and a Kalman filter as oracle."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from mjx_grasp.pipeline.config import PoseFilterConfig
from mjx_grasp.pipeline.pose_filter import estimated, start_estimate

DT = 0.01
CONFIG = PoseFilterConfig()


@partial(jax.jit, static_argnames="config")
def filtered(p, R, config=CONFIG):
    def tick(before, reading):
        after = estimated(before, *reading, DT, config)
        return after, after

    return jax.lax.scan(tick, start_estimate(p[0], R[0]), (p[1:], R[1:]))[1]


def readings(p, turns, position=0.0, rotation=0.0, lost=0.0, seed=0):
    """Positions and rotation vectors as a tracker gives them; what is lost stays as it was."""
    draw = np.random.default_rng(seed)
    p = p + position * draw.normal(size=p.shape)
    R = Rotation.from_rotvec(turns) * Rotation.from_rotvec(rotation * draw.normal(size=p.shape))
    R = R.as_matrix()
    for k in range(1, len(p)):
        if draw.uniform() < lost:
            p[k], R[k] = p[k - 1], R[k - 1]
    return jnp.asarray(p, jnp.float32), jnp.asarray(R, jnp.float32)


def still(ticks):
    return np.tile([0.5, -0.1, 0.06], (ticks, 1)), np.tile([0.2, 0.4, -0.3], (ticks, 1))


def test_readings_without_noise_are_taken_as_they_are():
    t = DT * np.arange(300)[:, None]
    p = 0.5 + np.concatenate([0.1 * np.sin(2 * t), np.maximum(t - 1, 0) * 0.1, 0 * t], axis=1)
    turns = np.concatenate([0 * t, 0.3 * np.sin(t), 0.5 * t], axis=1)
    p, R = readings(p, turns)
    found = filtered(p, R)
    # A sudden change of velocity is doubted for a few ticks, and little.
    np.testing.assert_allclose(found.p_wo, p[1:], atol=5e-4)
    np.testing.assert_allclose(found.R_wo, R[1:], atol=3e-3)
    smooth = np.r_[20:98, 110:299]
    moved = np.asarray(p[1:] - p[:-1]) / DT
    np.testing.assert_allclose(found.twist[smooth, :3], moved[smooth], atol=5e-3)


def test_an_object_at_rest_is_at_rest_and_where_it_is():
    found = filtered(*readings(*still(100)))
    p, R = readings(*still(100))
    np.testing.assert_array_equal(found.p_wo, p[1:])
    np.testing.assert_allclose(found.R_wo, R[1:], atol=1e-6)
    assert not np.any(found.twist)


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_noise_is_smoothed_and_is_no_motion(lost):
    p, turns = still(1000)
    found = filtered(*readings(p, turns, 0.005, 0.05, lost))
    late = slice(100, None)
    off = np.asarray(found.p_wo - p[1:])[late]
    assert off.std() < 0.5 * 0.005 and np.abs(off.mean(axis=0)).max() < 1e-3
    turned = Rotation.from_matrix(found.R_wo) * Rotation.from_rotvec(turns[1:]).inv()
    assert turned[late].as_rotvec().std() < 0.6 * 0.05
    assert np.mean(np.any(found.twist[late, :3], axis=-1)) < 0.02
    assert np.mean(np.any(found.twist[late, 3:], axis=-1)) < 0.02
    noise = np.sqrt(np.asarray(found.variance)[late].mean(axis=0))
    np.testing.assert_allclose(noise, [0.005, 0.05], rtol=0.15)


def test_a_moving_object_is_followed_through_noise_without_lag():
    p, turns = still(600)
    p[:, 0] += 0.1 * DT * np.maximum(np.arange(600) - 200, 0)
    found = filtered(*readings(p, turns, 0.005, 0.05, 0.2))
    off = np.asarray(found.p_wo - p[1:])[300:]
    assert np.abs(off.mean(axis=0)).max() < 1e-3 and off.std() < 0.004
    assert np.mean(np.any(found.twist[300:, :3], axis=-1)) > 0.95
    np.testing.assert_allclose(found.rates[300:, 0].mean(axis=0), [0.1, 0, 0], atol=0.01)


def test_a_push_is_followed_within_a_third_of_a_second():
    p, turns = still(400)
    p[200:, 1] += 0.05
    noisy = filtered(*readings(p, turns, 0.005, 0.05))
    assert np.linalg.norm(noisy.p_wo[235:] - p[236:], axis=-1).mean() < 0.006


def test_an_object_put_elsewhere_is_there_at_once():
    p, turns = still(400)
    p[200:, 1] += 0.05
    clean = filtered(*readings(p, turns))
    np.testing.assert_allclose(clean.p_wo, p[1:], atol=1e-6)
    assert clean.twist[199, 1] == pytest.approx(5.0, rel=1e-3) and not np.any(clean.twist[200:])


def test_an_object_that_stops_dead_is_not_taken_for_lost():
    p, turns = still(200)
    p[:, 0] += 0.5 * DT * np.clip(np.arange(200) - 100, 0, 7)  # pushed for 70 ms
    found = filtered(*readings(p, turns))
    np.testing.assert_allclose(found.p_wo[115:], p[116:], atol=1e-3)
    assert not np.any(found.twist[140:])


@pytest.mark.parametrize("noise", [0.001, 0.005])
def test_gains_are_those_of_a_steady_kalman_filter(noise):
    found = filtered(*readings(*still(4000), noise))
    # White acceleration, constant within a tick.
    push = np.array([DT**2 / 2, DT])[:, None] * CONFIG.acceleration
    step, seen = np.array([[1, DT], [0, 1]]), np.array([[1.0, 0]])
    ahead = solve_discrete_are(step.T, seen.T, push @ push.T, np.array([[noise**2]]))
    gain = ahead @ seen.T / (seen @ ahead @ seen.T + noise**2)
    kept = ahead - gain @ seen @ ahead
    off = np.asarray(found.p_wo)[1000:] - still(1)[0]
    rates = np.asarray(found.rates)[1000:, 0]
    # Of an object at rest the error is all noise, less than the filter allows for.
    alone = np.zeros((2, 2))
    for _ in range(2000):
        carried = (np.eye(2) - gain @ seen) @ step
        alone = carried @ alone @ carried.T + noise**2 * gain @ gain.T
    np.testing.assert_allclose(off.std(), np.sqrt(alone[0, 0]), rtol=0.1)
    np.testing.assert_allclose(rates.std(), np.sqrt(alone[1, 1]), rtol=0.15)
    assert alone[0, 0] < kept[0, 0]


def test_turning_the_world_turns_the_estimate():
    p, R = readings(*still(200), 0.004, 0.03)
    turn = jnp.asarray(Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), jnp.float32)
    one, other = filtered(p, R), filtered(p @ turn.T, turn @ R)
    np.testing.assert_allclose(one.p_wo @ turn.T, other.p_wo, atol=1e-5)
    np.testing.assert_allclose(turn @ one.R_wo, other.R_wo, atol=1e-4)
    np.testing.assert_allclose(one.rates[:, 0] @ turn.T, other.rates[:, 0], atol=1e-3)


def test_a_batch_is_the_map_over_its_worlds():
    p, R = (
        jnp.stack(x)
        for x in zip(*(readings(*still(20), 0.004, seed=k) for k in range(3)), strict=True)
    )
    start = jax.vmap(start_estimate)(p[:, 0], R[:, 0])
    many = jax.vmap(lambda s, a, b: estimated(s, a, b, DT, CONFIG))(start, p[:, 1], R[:, 1])
    for k in range(3):
        one = estimated(start_estimate(p[k, 0], R[k, 0]), p[k, 1], R[k, 1], DT, CONFIG)
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, atol=1e-6), many, one)
