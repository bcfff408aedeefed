"""The way out of a grasp: away from the object, and never worse than straight up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Box, Sphere
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.way_out import freer

UP = np.array([0.0, 0.0, 1.0])
LENGTH, ENOUGH = 0.15, 0.02
TIPS = jnp.array([[0.0, -0.06, 0.0], [0.02, 0.06, 0.0], [-0.02, 0.06, 0.0]])


def still(shape, p_wo=(0.0, 0.0, 0.0), R_wo=None):
    R_wo = jnp.eye(3) if R_wo is None else jnp.asarray(R_wo)
    return Surroundings.still(shape, jnp.asarray(p_wo), R_wo)


def chosen(way, around, tips=TIPS):
    return np.asarray(freer(jnp.asarray(way, jnp.float32), tips, LENGTH, around, ENOUGH))


def test_a_way_that_is_free_is_taken_even_where_up_is_freer():
    """Beside a box with flat sides the distance stays what it is."""
    box = still(Box(jnp.array([0.3, 0.03, 0.05])))
    for way in ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.8, 0.0, -0.6]):
        np.testing.assert_allclose(chosen(way, box), way, atol=1e-6)


def test_a_way_that_is_free_enough_is_taken_though_up_is_freer():
    """It passes a ball at a little more than what is enough; upwards nothing is near."""
    way, past = np.array([1.0, 0.0, 0.0]), ENOUGH + 0.005
    ball = Sphere(jnp.asarray(0.03))
    around = still(ball, np.asarray(TIPS[0]) + 0.1 * way - np.array([0.0, 0.03 + past, 0.0]))
    np.testing.assert_array_equal(chosen(way, around), way)
    nearer = still(ball, np.asarray(TIPS[0]) + 0.1 * way - np.array([0.0, 0.04, 0.0]))
    np.testing.assert_array_equal(chosen(way, nearer), UP)


def test_a_way_through_the_object_gives_way_to_straight_up():
    """A ball is in the way of one of the tips; the other way out is free."""
    ball = Sphere(jnp.asarray(0.03))
    for tip in range(3):
        way = np.array([1.0, 0.0, 0.0])
        around = still(ball, np.asarray(TIPS[tip]) + 0.1 * way)
        np.testing.assert_array_equal(chosen(way, around), UP)
        np.testing.assert_array_equal(chosen(-way, around), -way)


def test_where_both_are_blocked_it_is_the_freer():
    """Of tips in one place; against distances along finely divided ways."""
    ball, way, tips = 0.05, np.array([1.0, 0.0, 0.0]), jnp.zeros((3, 3))
    for p_wo in ((0.065, 0.0, 0.06), (0.06, 0.0, 0.065)):
        ways = np.linspace(0, LENGTH, 999)[:, None] * np.stack([way, UP])[:, None]
        away = np.linalg.norm(ways - np.array(p_wo), axis=-1).min(axis=1) - ball
        expected = (way, UP)[np.argmax(away)]
        assert (away < ENOUGH).all()
        around = still(Sphere(jnp.asarray(ball)), p_wo)
        np.testing.assert_allclose(chosen(way, around, tips), expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_it_is_the_same_wherever_all_stands_on_the_table(seed):
    """Turned about the vertical and shifted, with the object in any orientation of its own."""
    rng = np.random.default_rng(seed)
    box, own = Box(jnp.asarray(rng.uniform(0.02, 0.06, 3), jnp.float32)), rng.normal(size=3)
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    R = np.asarray(so3.exp(jnp.asarray(own, jnp.float32)))
    p = rng.uniform(-0.05, 0.05, 3)
    turn = np.asarray(so3.exp(jnp.asarray([0.0, 0.0, rng.uniform(-3, 3)], jnp.float32)))
    shift = rng.uniform(-1, 1, 3)
    here = chosen(way, still(box, p, R))
    there = chosen(
        turn @ way, still(box, turn @ p + shift, turn @ R), jnp.asarray(TIPS @ turn.T + shift)
    )
    np.testing.assert_allclose(there, turn @ here, atol=1e-5)
    compiled = jax.jit(lambda w: freer(w, TIPS, LENGTH, still(box, p, R), ENOUGH))
    np.testing.assert_array_equal(compiled(jnp.asarray(way, jnp.float32)), here)
