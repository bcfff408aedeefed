"""Plans of some worlds of many: whoever wants some gets its own, however many are made at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.evaluation.grasps.plans import Wanted, planned, planned_in_parts, with_plans

WORLDS = 7
ROWS = np.array([4, 1, 6])


class State(NamedTuple):
    phase: jax.Array
    ways: jax.Array


class Plans:
    """What a plan is made of, as the plan; and a state that counts how often it took one over."""

    def plan(self, library, known, seen, q, key, tried):
        return jnp.stack([library, known, seen, q.sum(), tried, jax.random.uniform(key)])

    def adopt(self, state, ways):
        return State(state.phase + 1, ways)


@pytest.fixture
def given():
    values = np.random.default_rng(0).normal(size=(4, WORLDS)).astype(np.float32)
    known, seen, q, tried = map(jnp.asarray, values)
    wanted = Wanted(known, seen, q[:, None], tried, jax.random.split(jax.random.key(3), WORLDS))
    return Plans(), jnp.float32(0.5), wanted


def one_by_one(grasper, library, wanted):
    known, seen, q, tried, keys = wanted
    return np.stack(
        [grasper.plan(library, known[w], seen[w], q[w], keys[w], tried[w]) for w in range(WORLDS)]
    )


@pytest.mark.wrong_types
@pytest.mark.parametrize("together", [None, 1, 2, 3, 5])
def test_plans_are_those_of_each_world_alone(given, together):
    expected = one_by_one(*given)
    found = planned(*given, ROWS, together)
    np.testing.assert_allclose(found, expected[ROWS], rtol=1e-6)
    assert len(np.unique(expected[:, -1])) == WORLDS, "every world tries its own"
    everyone = planned(*given, np.arange(WORLDS), together)
    np.testing.assert_allclose(everyone, expected, rtol=1e-6)


@pytest.mark.wrong_types
@pytest.mark.parametrize("together", [1, 2, 3, 5])
def test_those_that_want_plans_take_them_over_and_the_others_stay(given, together):
    before = State(jnp.arange(WORLDS), jnp.zeros((WORLDS, 6)))
    parts = list(planned_in_parts(*given, ROWS, together))
    assert all(len(rows) == len(ways) == together for rows, ways in parts)
    after = before
    for rows, ways in parts:
        after = with_plans(given[0], after, ways, rows)
    wants = np.isin(np.arange(WORLDS), ROWS)
    np.testing.assert_array_equal(after.phase, np.arange(WORLDS) + wants)
    expected = np.where(wants[:, None], one_by_one(*given), 0.0)
    np.testing.assert_allclose(after.ways, expected, rtol=1e-6)


@pytest.mark.wrong_types
def test_without_a_planner_there_are_none(given):
    grasper, _, *rest = given
    assert planned(grasper, None, *rest, ROWS) is None
