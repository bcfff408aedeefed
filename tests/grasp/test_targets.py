"""The ways to assign three tips to candidates, and which are high enough."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.config import SelectionConfig, TargetConfig
from mjx_grasp.grasp.select import HandPose, select, start_selection
from mjx_grasp.grasp.targets import (
    NONE,
    WAYS,
    admissible,
    closest_axis,
    heights,
    latched_options,
    standoffs,
    target_options,
)

CONFIG = TargetConfig()


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def some(n=50, seed=0, **fields):
    rng = np.random.default_rng(seed)
    made = {
        "thumb": rng.normal(size=(n, 3)),
        "normal": unit(rng.normal(size=(n, 3))),
        "wrap": rng.normal(size=(n, 2, 3)),
        "wrap_normal": unit(rng.normal(size=(n, 3))),
        "axis": unit(rng.normal(size=(n, 3))),
        "width": np.full(n, 0.05),
        "score": rng.uniform(0.1, 1.0, n),
    } | fields
    leaves = {name: jnp.asarray(leaf, jnp.float32) for name, leaf in made.items()}
    return Candidates(**leaves, valid=jnp.ones(n, bool))


def by_candidate(leaf):
    return np.asarray(leaf).reshape(-1, WAYS, *leaf.shape[1:])


def test_wraps_lie_across_grasp_axis_and_reach_axis():
    given = some()
    options = target_options(given, CONFIG)
    assert np.array_equal(by_candidate(options.candidate)[:, 0], np.arange(50))
    assert by_candidate(options.axis)[7].tolist() == [0, 0, 1, 1, 2, 2]
    thumb, first, second = np.moveaxis(by_candidate(options.position), 2, 0)
    assert np.array_equal(thumb, np.broadcast_to(given.thumb[:, None], thumb.shape))
    assert np.allclose(0.5 * (first + second), given.centre[:, None], atol=1e-6)
    spread = first - second
    assert np.allclose(np.linalg.norm(spread, axis=-1), 0.04, atol=1e-6)
    assert np.allclose(spread, 0.04 * by_candidate(options.spread), atol=1e-6)
    assert np.allclose(np.einsum("nvi,ni->nv", spread, given.axis), 0, atol=1e-6)
    for way in range(WAYS):
        assert np.allclose(spread[:, way, way // 2], 0, atol=1e-6)
    assert np.allclose(spread[:, ::2], -spread[:, 1::2], atol=1e-6)


def test_normals_are_the_thumbs_and_the_wraps():
    given = some()
    normal = by_candidate(target_options(given, CONFIG).normal)
    assert np.array_equal(normal[:, 3, 0], given.normal)
    assert np.array_equal(normal[:, 3, 1], given.wrap_normal)
    assert np.array_equal(normal[:, :, 1], normal[:, :, 2])


def test_a_reach_axis_along_the_grasp_axis_is_not_usable():
    given = some(4, axis=unit(np.array([[1, 0, 0], [0.05, 0, 1], [0.3, 1, 0], [0, 1, 1]])))
    given = given._replace(valid=given.valid.at[3].set(False))
    options = target_options(given, CONFIG)
    assert by_candidate(options.usable).tolist() == [
        [False, False, True, True, True, True],
        [True, True, True, True, False, False],
        [True] * 6,
        [False] * 6,
    ]
    assert np.isfinite(options.position).all()


def test_the_reach_axis_is_the_preferred_one_of_those_that_can_be_used():
    reach = np.array([[0.1, 0.2, 0.9], [0.1, 0.2, 0.9], [0.8, 0.3, 0.1]])
    usable = np.array([[True] * 3, [True, True, False], [True] * 3])
    assert closest_axis(reach, usable).tolist() == [2, 1, 0]


@pytest.mark.parametrize("seed", range(3))
def test_the_latched_way_is_one_of_all(seed):
    given = some(seed=seed)
    rng = np.random.default_rng(seed)
    reach = jnp.asarray(np.abs(unit(rng.normal(size=3))), jnp.float32)
    every, latched = target_options(given, CONFIG), latched_options(given, reach, CONFIG)
    rows = WAYS * np.arange(50) + 2 * np.asarray(latched.axis)
    for name in ("spread", "position", "normal", "usable"):
        same = np.asarray(getattr(every, name))[rows]
        np.testing.assert_array_equal(getattr(latched, name), same, err_msg=name)
    R, p = so3.exp(jnp.asarray(rng.normal(size=3), jnp.float32)), jnp.asarray([0.5, 0.0, 1.0])
    high = admissible(given, every, p, R, CONFIG)
    assert 0 < high.sum() < len(high)
    np.testing.assert_array_equal(admissible(given, latched, p, R, CONFIG), high[rows])


def test_standoffs_are_outside_by_25_and_40_mm():
    rng = np.random.default_rng(0)
    position, normal = rng.normal(size=(4, 6, 3, 3)), unit(rng.normal(size=(4, 1, 3, 3)))
    out = np.sum((standoffs(position, normal, CONFIG) - position) * normal, axis=-1)
    assert np.allclose(out, [0.025, 0.040, 0.040], atol=1e-6)


def test_heights_are_of_the_lowest_contact_target_and_goal():
    given = some()
    R = np.asarray(so3.exp(jnp.asarray([0.4, -1.0, 2.0])))
    p = np.array([0.5, 0.1, 0.3], np.float32)
    options = target_options(given, CONFIG)
    found = heights(given, options, jnp.asarray(p), jnp.asarray(R), CONFIG)
    lowest, goal = map(np.asarray, found)
    for k, way in ((0, 0), (17, 3), (49, 5)):
        row = WAYS * k + way
        target = p + np.asarray(options.position)[row] @ R.T
        points = np.concatenate([target, p + np.asarray(given.wrap)[k] @ R.T])
        assert lowest[row] == pytest.approx(float(points[:, 2].min()), abs=1e-5)
        outside = target + np.array([0.025, 0.04, 0.04])[:, None] * (
            np.asarray(options.normal)[row] @ R.T
        )
        assert goal[row] == pytest.approx(float(outside[:, 2].min()), abs=1e-5)


def test_enumeration_is_jittable_and_batched():
    given = [some(seed=seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)
    together = jax.jit(jax.vmap(lambda c: target_options(c, CONFIG).position))(stacked)
    for k, one in enumerate(given):
        np.testing.assert_allclose(together[k], target_options(one, CONFIG).position, atol=1e-6)


def _one_below(standoff):
    """A candidate whose thumb is held from below, and settings with its standoff."""
    down = np.array([[0.0, 0.0, -1.0]])
    given = some(
        1,
        thumb=[[0.0, 0.0, 0.0]],
        normal=down,
        wrap=[[[0.0, 0.0, 0.05]] * 2],
        wrap_normal=-down,
        axis=-down,
    )
    return given, TargetConfig(thumb_standoff=standoff, min_goal_height=0.012)


@pytest.mark.parametrize(("standoff", "fits"), [(0.025, True), (0.040, False)])
def test_a_standoff_says_where_the_tips_go_and_how_high_that_must_be(standoff, fits):
    """One setting for the height test and the goals, of all ways and of the selection."""
    given, config = _one_below(standoff)
    p, R = jnp.asarray([0.5, 0.0, 0.045]), jnp.eye(3)
    options = target_options(given, config)
    goal = standoffs(options.position, options.normal, config)[0, 0]
    np.testing.assert_allclose(goal, [0.0, 0.0, -standoff], atol=1e-7)
    assert admissible(given, options, p, R, config).any() == fits
    hand = HandPose(jnp.asarray(np.eye(3) * 0.1), jnp.eye(3)[0], jnp.eye(3)[2])
    selection = SelectionConfig(targets=config)
    chosen, _ = select(given, start_selection(given, hand, R), hand, p, R, selection)
    assert bool(chosen.valid) == fits and (int(chosen.candidate) != NONE) == fits


@pytest.mark.parametrize(
    "fields", [{"thumb_standoff": -1.0}, {"wrap_spread": np.nan}, {"min_axis_angle": 2.0}]
)
def test_impossible_targets_are_refused(fields):
    with pytest.raises(InputError, match=next(iter(fields))):
        replace(CONFIG, **fields)
