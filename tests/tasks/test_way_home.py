"""The way home over a corner above the handoff, and how long the way back is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.tasks.way_home import ASTRAY, RAISING, build_way_home

POSTURES, HEIGHT = 11, 0.1


@pytest.fixture(scope="module")
def over(scene, starts):
    return build_way_home(scene, starts, POSTURES, HEIGHT)


@pytest.fixture(scope="module")
def straight(scene, starts):
    return build_way_home(scene, starts, POSTURES)


def along(way, starts):
    """Configurations of the ways, start by start."""
    return np.asarray(way.measured.q).reshape(len(starts.qpos), POSTURES, -1)


def test_at_the_corner_the_palm_is_straight_above_the_handoff(over, starts):
    corner = round(RAISING * (POSTURES - 1))
    palm = np.asarray(over.measured.palm_pos).reshape(len(starts.qpos), POSTURES, 3)
    rise = palm[:, corner] - palm[:, 0]
    np.testing.assert_allclose(rise, np.tile([0, 0, HEIGHT], (len(rise), 1)), atol=2e-3)
    turned = np.asarray(over.measured.palm_mat).reshape(len(starts.qpos), POSTURES, 3, 3)
    np.testing.assert_allclose(turned[:, corner], turned[:, 0], atol=2e-2)
    np.testing.assert_allclose(along(over, starts)[:, corner], over.corner, atol=1e-6)


def test_it_has_the_same_ends_as_the_straight_way_and_two_straight_parts(
    over, straight, starts, scene
):
    q, plain = along(over, starts), along(straight, starts)
    np.testing.assert_allclose(q[:, [0, -1]], plain[:, [0, -1]], atol=1e-6)
    np.testing.assert_allclose(q[:, -1], np.tile(scene.robot.home, (len(q), 1)), atol=1e-6)
    corner = round(RAISING * (POSTURES - 1))
    for part in (q[:, : corner + 1], q[:, corner:]):
        np.testing.assert_allclose(np.diff(part, n=2, axis=1), 0.0, atol=2e-6)
    assert straight.corner is None


@pytest.mark.parametrize("name", ["over", "straight"])
def test_the_way_left_falls_along_the_way_and_is_as_long_as_what_is_left(name, request, starts):
    """Exactly on the part that ends at the handoff; sharp corners before it may be cut."""
    way = request.getfixturevalue(name)
    q, joints = along(way, starts), np.arange(0, 18, 2)
    steps = np.linalg.norm(np.diff(q[..., joints], axis=1), axis=-1)
    left = np.concatenate([np.zeros((len(q), 1)), np.cumsum(steps, axis=1)], axis=1)
    rows = jnp.arange(len(q))
    found = np.stack([way.left(jnp.asarray(q[:, k]), rows, joints) for k in range(POSTURES)], 1)
    assert (np.diff(found, axis=1) > 0).all()
    exact = POSTURES if way.corner is None else round(RAISING * (POSTURES - 1)) + 1
    np.testing.assert_allclose(found[:, :exact], left[:, :exact], atol=1e-4)
    straight = np.linalg.norm((q - q[:, :1])[..., joints], axis=-1)
    assert (found <= left + 1e-4).all() and (found >= straight - 1e-4).all()


def test_the_way_left_is_a_potential_without_jumps_that_is_zero_at_the_handoff(over, starts):
    most = np.hypot(1.0, ASTRAY)
    rng, joints = np.random.default_rng(0), np.arange(7)
    rows = jnp.asarray(rng.integers(len(starts.qpos), size=200))
    q = along(over, starts)[np.asarray(rows), rng.integers(POSTURES, size=200)]
    a = q + rng.normal(size=q.shape) * rng.uniform(0, 0.5, (200, 1))
    b = a + rng.normal(size=q.shape) * rng.uniform(0, 0.5, (200, 1))
    left = jax.jit(lambda x: over.left(jnp.asarray(x, jnp.float32), rows, joints))
    step = np.linalg.norm((b - a)[:, joints], axis=-1)
    assert (np.abs(np.asarray(left(b) - left(a))) <= most * step + 1e-4).all()
    handoff = np.asarray(starts.measured.q)[np.asarray(rows)]
    away = np.linalg.norm((a - handoff)[:, joints], axis=-1)
    found = np.asarray(left(a))
    assert (found >= away - 1e-4).all() and (found <= most * away + 1e-4).all()
    np.testing.assert_allclose(left(handoff), 0.0, atol=1e-5)
