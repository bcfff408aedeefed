import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjx_grasp.closing.config import GuidanceConfig
from mjx_grasp.closing.guidance import goal_frame, guidance_field, twist_norm

CONFIG = GuidanceConfig()
seeds = st.integers(0, 2**31)
# Compiled once for the many examples.
guided, framed = jax.jit(guidance_field, static_argnums=5), jax.jit(goal_frame)


def field(x, R, start, goal, goal_R, config=CONFIG):
    args = (jnp.asarray(a, jnp.float32) for a in (x, R, start, goal, goal_R))
    return np.asarray(guided(*args, config))


def expected_field(x, R, start, goal, goal_R):
    """Method §5 in float64, one pad, with its published numbers written out."""
    length = np.linalg.norm(goal - start)
    d = (goal - start) / length
    s = min(max((x - start) @ d, 0.0), length)
    nearest = start + s * d
    linear = 0.08 * min(1.0, (length - s) / 0.02) * d + 4.0 * (nearest - x)
    angular = 4.0 * Rotation.from_matrix(goal_R @ R.T).as_rotvec()
    return np.concatenate([linear, angular])


def case(seed, turn=2.5):
    rng = np.random.default_rng(seed)
    start = rng.normal(size=3) * 0.3
    goal = start + rng.normal(size=3) * 0.05
    x = start + rng.uniform(-0.3, 1.3) * (goal - start) + rng.normal(size=3) * 0.01
    goal_R = Rotation.random(random_state=rng)
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0, turn)) * goal_R
    return x, R.as_matrix(), start, goal, goal_R.as_matrix()


@given(seed=seeds)
def test_field_agrees_with_the_equations(seed):
    args = case(seed)
    np.testing.assert_allclose(field(*args), expected_field(*args), atol=2e-4)


@given(seed=seeds)
def test_field_vanishes_at_the_goal_pose(seed):
    _, _, start, goal, goal_R = case(seed)
    np.testing.assert_allclose(field(goal, goal_R, start, goal, goal_R), 0.0, atol=2e-5)


@given(seed=seeds)
def test_linear_field_is_continuous(seed):
    x, R, start, goal, goal_R = case(seed)
    step = np.random.default_rng(seed + 1).normal(size=3) * 1e-3
    change = field(x + step, R, start, goal, goal_R) - field(x, R, start, goal, goal_R)
    # Slopes: v_max/ε_p along the line, η across it, at most both.
    assert np.linalg.norm(change[:3]) <= (0.08 / 0.02 + 4.0) * np.linalg.norm(step) + 1e-5


@given(seed=seeds)
def test_angular_field_is_continuous_below_a_half_turn(seed):
    x, R, start, goal, goal_R = case(seed, turn=2.0)
    near = Rotation.from_rotvec([1e-3, -2e-3, 1e-3]).as_matrix() @ R
    change = field(x, near, start, goal, goal_R) - field(x, R, start, goal, goal_R)
    # The logarithm stretches by (a/2)/sin(a/2) < 1.2 below 2 rad.
    assert np.linalg.norm(change[3:]) <= 4.0 * 1.2 * np.linalg.norm([1e-3, 2e-3, 1e-3]) + 5e-5


@given(seed=seeds)
def test_half_turns_are_finite_and_of_the_right_size(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    goal_R = Rotation.random(random_state=rng).as_matrix()
    for angle in (np.pi, np.pi - 1e-4, np.pi - 1e-7):
        R = Rotation.from_rotvec(axis * angle).as_matrix() @ goal_R
        omega = field(np.zeros(3), R, np.zeros(3), np.ones(3) * 0.1, goal_R)[3:]
        np.testing.assert_allclose(np.linalg.norm(omega), 4.0 * np.pi, rtol=1e-3)
        np.testing.assert_allclose(np.abs(omega @ axis), 4.0 * np.pi, rtol=1e-3)


def test_start_on_the_goal_is_finite():
    point = np.array([0.5, 0.1, 0.05])
    assert np.isfinite(field(point + 0.01, np.eye(3), point, point, np.eye(3))).all()
    at_goal = field(point, np.eye(3), point, point, np.eye(3))
    np.testing.assert_allclose(at_goal, 0.0, atol=1e-5)


@given(seed=seeds)
def test_turning_everything_turns_the_field(seed):
    args = case(seed)
    rng = np.random.default_rng(seed + 2)
    T = Rotation.random(random_state=rng).as_matrix()
    x, R, start, goal, goal_R = args
    turned = field(T @ x, T @ R, T @ start, T @ goal, T @ goal_R)
    straight = field(*args)
    expected = np.concatenate([T @ straight[:3], T @ straight[3:]])
    np.testing.assert_allclose(turned, expected, atol=5e-4)


def test_following_the_field_arrives():
    x, R, start, goal, goal_R = case(5)
    dt = 0.01
    for _ in range(400):
        twist = field(x, R, start, goal, goal_R)
        x = x + dt * twist[:3]
        R = Rotation.from_rotvec(dt * twist[3:]).as_matrix() @ R
    assert np.linalg.norm(x - goal) < 1e-4
    assert Rotation.from_matrix(goal_R @ R.T).magnitude() < 1e-3


@given(seed=seeds)
def test_goal_frame_turns_the_pad_least(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    goal = np.asarray(framed(jnp.asarray(R, jnp.float32), jnp.asarray(n, jnp.float32)))
    np.testing.assert_allclose(goal @ goal.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(goal[:, 0], -n, atol=1e-5)
    least = np.arccos(np.clip(R[:, 0] @ -n, -1, 1))
    np.testing.assert_allclose(Rotation.from_matrix(goal @ R.T).magnitude(), least, atol=2e-3)


def test_goal_frame_of_a_pad_that_faces_away():
    goal = np.asarray(goal_frame(jnp.eye(3), jnp.array([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(goal[:, 0], [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(goal), 1.0, atol=1e-5)


def test_twist_norm_weighs_turning_in_metres():
    assert np.isclose(twist_norm(jnp.array([3.0, 0, 4.0, 0, 0, 0]), 0.05), 5.0)
    assert np.isclose(twist_norm(jnp.array([0.0, 0, 0, 0, 0, 2.0]), 0.05), 0.1, rtol=1e-4)
    both = twist_norm(jnp.array([0.3, 0, 0, 8.0, 0, 0]), 0.05)
    assert np.isclose(both, 0.5)
