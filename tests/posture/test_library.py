"""The library of start postures, and which of them are chosen."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.signed_distance import Sphere
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.config import StartConfig
from mjx_grasp.posture.ik import TipGoals
from mjx_grasp.posture.library import Library, Options, build_library, choose_starts
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.sim.scene import ObjectArea

OPTIONS = 5
PLAIN = StartConfig(near=400, count=8, chance=0.0, time_scale=0.0)
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def library(body):
    return build_library(body, 400, ObjectArea(), seed=0)


@pytest.fixture(scope="module")
def options():
    rng = np.random.default_rng(0)
    centre = np.array([0.5, 0.0, 0.15])
    tips = centre + rng.uniform(-0.08, 0.08, (OPTIONS, 3, 3))
    pads = rng.normal(size=(OPTIONS, 3, 3))
    pads /= np.linalg.norm(pads, axis=-1, keepdims=True)
    admissible = np.array([True, True, False, True, True])
    goals = TipGoals(jnp.asarray(tips, jnp.float32), jnp.asarray(pads, jnp.float32))
    return Options(goals, jnp.asarray(admissible))


@pytest.fixture(scope="module")
def around():
    centre = jnp.asarray([0.5, 0.0, 0.15])
    return Surroundings.still(Sphere(jnp.float32(0.03)), centre, jnp.eye(3))


def chosen(body, library, config, options, around, q=None, key=KEY):
    q = jnp.asarray(body.home) if q is None else q
    return choose_starts(body, library, config, options, around, q, key)


def gaps(library, options, scale):
    """Of every entry to every option, in double precision."""

    def features(tips, pads):
        parts = np.asarray(tips, float), scale * np.asarray(pads, float)
        return np.concatenate([part.reshape(-1, 9) for part in parts], axis=1)

    have = features(library.tips, library.pads)
    want = features(*options.goals)
    gap = np.sum((have[:, None] - want) ** 2, axis=-1)
    return np.where(options.admissible, gap, np.inf)


def test_the_library_knows_where_its_configurations_put_tips_and_pads(body, library):
    pos, mat = jax.jit(jax.vmap(body.kinematics.forward))(library.q)
    np.testing.assert_allclose(library.tips, pos[:, :FINGERS], atol=1e-5)
    np.testing.assert_allclose(library.pads, mat[:, FINGERS:PALM, :, 0], atol=1e-5)


def test_the_nearest_entries_come_first_each_with_its_nearest_option(
    body, library, options, around
):
    starts = chosen(body, library, PLAIN, options, around)
    gap = gaps(library, options, PLAIN.direction_scale)
    order = np.argsort(gap.min(axis=1))[: PLAIN.count]
    np.testing.assert_array_equal(starts.q, library.q[order])
    np.testing.assert_array_equal(starts.option, gap.argmin(axis=1)[order])
    assert 2 not in starts.option


def test_time_draws_the_choice_to_the_present_configuration(body, library, options, around):
    q = library.q[123]
    starts = chosen(body, library, replace(PLAIN, time_scale=100.0), options, around, q)
    np.testing.assert_array_equal(starts.q[0], q)


def test_only_what_is_around_the_object_is_looked_at(body, library, options, around):
    few = replace(PLAIN, near=20)
    middle = 0.5 * library.tips[:, 0] + 0.25 * (library.tips[:, 1] + library.tips[:, 2])
    nearest = np.argsort(np.linalg.norm(middle - around.p_wo, axis=1))[:20]
    found = np.asarray(chosen(body, library, few, options, around).q)
    assert {tuple(q) for q in found} <= {tuple(q) for q in np.asarray(library.q)[nearest]}
    # With some chance, other keys find others.
    lucky = replace(few, chance=0.2)
    first, again, other = (
        np.asarray(chosen(body, library, lucky, options, around, key=jax.random.key(k)).q)
        for k in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_overlap_puts_hands_behind_that_would_be_in_the_object(body, library):
    # The goals are exactly where two entries have their tips; the palm of one is in the object.
    palm = np.asarray(jax.jit(jax.vmap(lambda q: body.palm.forward(q)[0][0]))(library.q))
    gap = np.linalg.norm(palm[:, None] - palm, axis=-1)
    clear, hit = np.unravel_index(gap.argmax(), gap.shape)
    two = Library(*(leaf[np.array([hit, clear])] for leaf in library))
    around = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.asarray(palm[hit]), jnp.eye(3))
    goals = TipGoals(two.tips + jnp.asarray([[[0.0]], [[1e-3]]]), two.pads)
    options = Options(goals, jnp.ones(2, bool))
    for weight, first in ((0.0, 0), (5.0, 1)):
        config = replace(PLAIN, count=2, overlap_weight=weight)
        starts = chosen(body, two, config, options, around)
        assert starts.option.tolist() == [first, 1 - first]


@pytest.mark.long
def test_batched_is_looped_and_jit_is_eager(body, library, options, around):
    config = StartConfig(near=50, count=4, overlap_weight=2.0, ranked=12)
    shifts = jnp.asarray([[0.0, 0, 0], [0.05, 0.05, 0], [-0.05, 0.1, 0.02]])
    home = jnp.asarray(body.home)
    choose = partial(choose_starts, body, library, config)

    def one(shift, key):
        moved = TipGoals(options.goals.tips + shift, options.goals.pads)
        place = around._replace(p_wo=around.p_wo + shift)
        return choose(Options(moved, options.admissible), place, home, key)

    keys = jax.random.split(KEY, 3)
    batched = jax.jit(jax.vmap(one))(shifts, keys)
    for k in range(3):
        single = one(shifts[k], keys[k])
        np.testing.assert_array_equal(batched.option[k], single.option)
        np.testing.assert_array_equal(batched.q[k], single.q)


def test_more_starts_than_entries_that_are_compared_are_refused() -> None:
    with pytest.raises(InputError, match=r"count.*at most near, 3"):
        StartConfig(near=3, count=4)


def test_more_starts_than_are_ranked_are_refused() -> None:
    assert StartConfig(count=12, overlap_weight=2.0, ranked=12).count == 12
    assert StartConfig(count=13, ranked=12).count == 13  # nothing is ranked by its overlap
    with pytest.raises(InputError, match=r"count.*13.*at most ranked, 12"):
        StartConfig(count=13, overlap_weight=2.0, ranked=12)
