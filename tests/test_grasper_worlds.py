"""The bookkeeping of the benchmark of many whole grasps: which worlds get which plans."""

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


class State(NamedTuple):
    """As much of a grasp's state as the bookkeeping looks at."""

    ways: Any
    tried: Any


class Planner:
    """Plans that say for whom they were made."""

    def plan(self, library, known, seen, q, key, tried):
        return {"of": q[0], "at": seen.p_wo}

    def adopt(self, state, ways):
        return state._replace(ways=ways)


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("grasper_worlds")


@pytest.fixture
def worlds(module):
    count = 7
    place = jnp.arange(3.0 * count).reshape(count, 3)
    truth = SimpleNamespace(
        object_pos=place,
        object_quat=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        tip_found=jnp.zeros((count, 3), bool),
    )
    measured = SimpleNamespace(q=10.0 + jnp.arange(2.0 * count).reshape(count, 2))
    ways = {"of": jnp.full(count, -1.0), "at": jnp.full((count, 3), -1.0)}
    grasp = State(ways, jnp.full((count, 3), jnp.inf))
    due = jnp.array([True, False, True, True, False, False, True])
    return module.Worlds(None, measured, truth, grasp, due, jnp.zeros(count, bool))


def plans(module, batch):
    return lambda *given: module.plans_of(Planner(), None, None, batch, *given)


@pytest.mark.parametrize("batch", [1, 2, 3, 8])
def test_plans_come_in_the_order_of_their_worlds_whatever_the_batch(module, worlds, batch):
    rows = np.array([5, 0, 3, 6, 1])
    found = plans(module, batch)(worlds, jax.random.key(0), rows)
    np.testing.assert_array_equal(found["of"], np.asarray(worlds.measured.q)[rows, 0])
    np.testing.assert_array_equal(found["at"], np.asarray(worlds.truth.object_pos)[rows])


def test_worlds_that_want_none_keep_their_plans(module, worlds):
    due = np.flatnonzero(worlds.due)
    after = module.planned_anew(Planner(), plans(module, 3), worlds, jax.random.key(0), due)
    asked = np.asarray(worlds.due)
    expected = np.where(asked, np.asarray(worlds.measured.q)[:, 0], -1.0)
    np.testing.assert_array_equal(after.grasp.ways["of"], expected)
    assert not np.any(after.due)
