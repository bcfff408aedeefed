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


def readings(p, turns, position=0.0, rotation=0.0, lost=0.0, held=1, seed=0):
    """Positions and rotation vectors as a tracker gives them; what is lost stays as it was."""
    draw = np.random.default_rng(seed)
    p = p + position * draw.normal(size=p.shape)
    R = Rotation.from_rotvec(turns) * Rotation.from_rotvec(rotation * draw.normal(size=p.shape))
    R = R.as_matrix()
    for k in range(1, len(p)):
        if k % held or draw.uniform() < lost:
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


def moving(ticks, speed=0.1, since=200):
    p, turns = still(ticks)
    p[:, 0] += speed * DT * np.maximum(np.arange(ticks) - since, 0)
    return p, turns


def turned_off(found, turns):
    """Angles between the estimated rotations and the true ones [rad]."""
    off = Rotation.from_matrix(found.R_wo) * Rotation.from_rotvec(turns[1:]).inv()
    return np.linalg.norm(off.as_rotvec(), axis=-1)


def moves(found):
    """Whether it counts as moving, as reaching counts."""
    speeds = np.linalg.norm(found.twist[:, :3], axis=-1) + np.linalg.norm(
        found.twist[:, 3:], axis=-1
    )
    return speeds * DT > 1e-4


def test_an_object_at_rest_is_at_rest_and_where_it_is():
    found = filtered(*readings(*still(100)))
    p, R = readings(*still(100))
    np.testing.assert_allclose(found.p_wo, p[1:], atol=1e-7)
    np.testing.assert_allclose(found.R_wo, R[1:], atol=1e-6)
    assert not moves(found).any()


@pytest.mark.parametrize(
    ("lost", "held"), [(0.0, 1), (0.2, 1), (0.0, 3), (0.3, 3), (0.0, 8), (0.0, 10)]
)
def test_noise_is_smoothed_and_is_no_motion(lost, held):
    p, turns = still(3000)
    found = filtered(*readings(p, turns, 0.005, 0.05, lost, held))
    late = slice(300, None)
    off = np.asarray(found.p_wo - p[1:])[late]
    smoother = {1: 0.4, 3: 0.65, 8: 0.8, 10: 0.9}[held]
    assert off.std() < smoother * 0.005 and np.abs(off.mean(axis=0)).max() < 1e-3
    turned = turned_off(found, turns)[late] / np.sqrt(3)
    assert np.sqrt((turned**2).mean()) < smoother * 0.05
    assert moves(found)[late].mean() < 0.02
    noise = np.sqrt(np.asarray(found.noise)[late].mean(axis=0))
    np.testing.assert_allclose(noise, [0.005, 0.05], rtol=0.15)


@pytest.mark.parametrize(("position", "rotation"), [(0.003, 1e-4), (3e-5, 0.03), (0.0, 0.03)])
@pytest.mark.parametrize("held", [1, 3, 6])
def test_a_clean_channel_stays_clean_beside_a_noisy_one(position, rotation, held):
    p, turns = still(1500)
    found = filtered(*readings(p, turns, position, rotation, held=held))
    late = slice(200, None)
    assert np.linalg.norm(found.p_wo - p[1:], axis=-1)[late].max() < 5 * position + 1e-3
    assert turned_off(found, turns)[late].max() < 5 * rotation + 1e-2
    assert moves(found)[late].mean() < 0.05


@pytest.mark.parametrize(
    ("position", "rotation", "held"),
    [(0.005, 0.05, 1), (0.003, 0.03, 3), (0.0, 0.03, 3), (0.003, 0.03, 8)],
)
def test_a_moving_object_is_followed_through_noise_without_lag(position, rotation, held):
    p, turns = moving(900)
    p_read, R_read = readings(p, turns, position, rotation, 0.1, held)
    found = filtered(p_read, R_read)
    late = slice(400, None)
    off = np.asarray(found.p_wo - p[1:])[late]
    assert np.abs(off.mean(axis=0)).max() < 1.5e-3
    assert np.sqrt((off**2).mean()) < np.sqrt((np.asarray(p_read - p)[1:][late] ** 2).mean())
    assert moves(found)[late].mean() > 0.95
    np.testing.assert_allclose(found.rates[late, 0].mean(axis=0), [0.1, 0, 0], atol=0.01)


def test_a_tracker_without_noise_may_be_slow():
    found = filtered(*readings(*moving(900), held=3))
    off = np.asarray(found.p_wo)[400:] - moving(900)[0][401:]
    assert np.abs(off).max() < 2e-3 and moves(found)[400:].all()


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


def test_a_tracker_that_loses_the_object_for_a_second_finds_it_again():
    p, turns = still(900)
    p[500:, 1] += 0.2
    p_read, R_read = (np.array(x) for x in readings(p, turns, 0.003, 0.03))
    p_read[400:500], R_read[400:500] = p_read[399], R_read[399]
    found = filtered(jnp.asarray(p_read), jnp.asarray(R_read))
    off = np.linalg.norm(found.p_wo - p[1:], axis=-1)
    assert off[399:499].max() < 0.02 and off[500:].max() < 0.02
    assert moves(found)[430:498].mean() < 0.05 and moves(found)[510:].mean() < 0.05
    np.testing.assert_allclose(np.sqrt(found.noise[499]), [0.003, 0.03], rtol=0.4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_no_reading(bad):
    p, R = (np.array(x) for x in readings(*moving(600), 0.003, 0.03))
    gone = np.random.default_rng(1).uniform(size=600) < 0.2
    gone[0] = False
    p[gone, 0], R[gone] = bad, bad
    found = filtered(jnp.asarray(p), jnp.asarray(R))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert np.linalg.norm(found.p_wo[300:] - moving(600)[0][301:], axis=-1).max() < 0.012


def test_two_poses_that_it_flips_between_are_not_averaged():
    p, turns = still(2000)
    flips = np.random.default_rng(2).uniform(size=(2000, 1)) < 0.05
    turns = np.where(flips, [0.0, 0.0, np.pi], 0.0)
    found = filtered(*readings(p, turns, 0.003, 0.03))
    angle = np.linalg.norm(Rotation.from_matrix(found.R_wo).as_rotvec(), axis=-1)
    between = (angle > 0.3) & (angle < np.pi - 0.3)
    assert between.mean() < 0.05


@pytest.mark.parametrize("noise", [0.001, 0.005])
def test_it_is_a_kalman_filter_of_white_acceleration(noise):
    found = filtered(*readings(*still(4000), noise))
    q = CONFIG.agility
    step, seen = np.array([[1, DT], [0, 1]]), np.array([[1.0, 0]])
    push = q * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    ahead = solve_discrete_are(step.T, seen.T, push, np.array([[noise**2]]))
    gain = ahead @ seen.T / (seen @ ahead @ seen.T + noise**2)
    kept = (np.eye(2) - gain @ seen) @ ahead
    late = slice(1000, None)
    np.testing.assert_allclose(np.sqrt(found.noise[late, 0].mean()), noise, rtol=0.1)
    wanted = [kept[0, 0], kept[0, 1], kept[1, 1]]
    np.testing.assert_allclose(
        np.asarray(found.covariance)[late, :, 0].mean(axis=0), wanted, rtol=0.15
    )
    # Of an object at rest the error is all noise, less than the filter allows for.
    alone = np.zeros((2, 2))
    for _ in range(2000):
        carried = (np.eye(2) - gain @ seen) @ step
        alone = carried @ alone @ carried.T + noise**2 * gain @ gain.T
    off = np.asarray(found.p_wo)[late] - still(1)[0]
    np.testing.assert_allclose(off.std(), np.sqrt(alone[0, 0]), rtol=0.1)
    np.testing.assert_allclose(
        np.asarray(found.rates)[late, 0].std(), np.sqrt(alone[1, 1]), rtol=0.15
    )


def test_turning_the_world_turns_the_estimate():
    p, R = readings(*moving(400), 0.004, 0.03, 0.2)
    p = p.at[300:].add(jnp.array([0.0, 0.3, 0.0]))
    turn = jnp.asarray(Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), jnp.float32)
    one, other = filtered(p, R), filtered(p @ turn.T, turn @ R)
    np.testing.assert_allclose(one.p_wo @ turn.T, other.p_wo, atol=1e-5)
    np.testing.assert_allclose(turn @ one.R_wo, other.R_wo, atol=1e-4)
    np.testing.assert_allclose(one.rates[:, 0] @ turn.T, other.rates[:, 0], atol=1e-3)


def test_a_batch_is_the_map_over_its_worlds():
    each = [readings(*moving(60, since=20), 0.004, 0.03, 0.3, seed=k) for k in range(3)]
    p, R = (jnp.stack(x) for x in zip(*each, strict=True))
    many = jax.vmap(filtered)(p, R)
    for k in range(3):
        one = filtered(*each[k])
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, atol=1e-4), many, one)
