"""Where the palm comes from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.posture.body import FINGERS, PALM, robot_body
from mjx_grasp.posture.library import build_library
from mjx_grasp.reaching.approach import approaching, deviation
from mjx_grasp.sim.scene import ObjectArea


@pytest.fixture(scope="module")
def library(body):
    return build_library(body, 2000, ObjectArea(), 0)


def off(body, q, approach):
    return np.asarray(jax.jit(jax.vmap(lambda q: deviation(body, q, approach)))(q))


def axes(body, q):
    mat = jax.jit(jax.vmap(lambda q: body.kinematics.motion(q).mat[PALM]))(q)
    return np.asarray(mat @ body.approach_axis)


@pytest.mark.long
def test_deviations_are_angles_of_the_palms_axis(body, library):
    q = library.q[:50]
    axis = axes(body, q)
    from_down = np.arccos(np.clip(-axis[:, 2], -1, 1))
    np.testing.assert_allclose(off(body, q, "above"), from_down, atol=2e-3)
    from_level = np.abs(np.arcsin(np.clip(axis[:, 2], -1, 1)))
    np.testing.assert_allclose(off(body, q, "side"), from_level, atol=2e-3)
    assert not np.any(off(body, q, "any"))


def test_turning_the_whole_robot_changes_no_deviation(body, library):
    q = library.q[:20]
    turned = q.at[:, 0].add(0.4)
    for approach in ("above", "side"):
        np.testing.assert_allclose(off(body, q, approach), off(body, turned, approach), atol=2e-3)


@pytest.mark.parametrize("approach", ["above", "side"])
def test_a_library_keeps_what_comes_from_there(body, library, approach):
    kept = approaching(body, library, approach, 0.6)
    assert 0 < len(kept.q) < len(library.q)
    assert (np.asarray(off(body, kept.q, approach)) <= 0.6 + 1e-3).all()
    tips = jax.jit(jax.vmap(lambda q: body.kinematics.motion(q).pos[:FINGERS]))(kept.q)
    np.testing.assert_allclose(kept.tips, tips, atol=1e-5)


def test_any_keeps_all_and_none_is_an_error(body, library):
    assert approaching(body, library, "any", 0.1) is library
    with pytest.raises(InputError, match=r"plan\.approach"):
        approaching(body, jax.tree.map(lambda leaf: leaf[:1], library), "above", 1e-6)


def test_a_robot_on_a_pedestal_is_the_same_robot_higher_up(robot):
    q = jnp.asarray(robot.home)
    low, high = (robot_body(r).kinematics.motion(q) for r in (robot, robot.mounted(0.05)))
    np.testing.assert_allclose(high.pos - low.pos, [[0, 0, 0.05]] * len(low.pos), atol=1e-6)
    np.testing.assert_allclose(high.mat, low.mat, atol=1e-6)
    assert robot.mounted(0.05).identity == robot.identity
