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

    phase: Any
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
    grasp = State(jnp.zeros(count, int), ways, jnp.full((count, 3), jnp.inf))
    due = jnp.array([True, False, True, True, False, False, True])
    return module.Worlds(None, measured, truth, grasp, due, jnp.zeros(count, bool))


@pytest.mark.wrong_types
@pytest.mark.parametrize("batch", [1, 3, 8])
def test_worlds_that_want_none_keep_their_plans_whatever_the_batch(module, worlds, batch):
    due = np.flatnonzero(worlds.due)
    key = jax.random.key(0)
    after = module.planned_anew(Planner(), None, None, batch, worlds, key, due)
    asked = np.asarray(worlds.due)
    expected = np.where(asked, np.asarray(worlds.measured.q)[:, 0], -1.0)
    np.testing.assert_array_equal(after.grasp.ways["of"], expected)
    places = np.asarray(worlds.truth.object_pos)
    np.testing.assert_array_equal(after.grasp.ways["at"], np.where(asked[:, None], places, -1.0))
    assert not np.any(after.due)
