"""How hard a whole grasp may press, by the weight of its object."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.pressing import budget_for

WEIGHTS = st.floats(0.01, 50.0)
BUDGETS = st.floats(0.5, 20.0)


def budget(weight, given=8.0, **settings):
    """As a number."""
    return float(budget_for(jnp.float32(weight), given, GrasperConfig(**settings)))


@given(WEIGHTS, WEIGHTS, BUDGETS)
def test_a_policy_has_as_much_of_its_budget_as_the_weight_asks_for(one, other, most):
    light, heavy = (budget(weight, most) for weight in sorted((one, other)))
    assert light <= heavy <= most * (1 + 1e-6)
    assert light >= min(most, GrasperConfig().least_budget) * (1 - 1e-6)


def test_the_budget_is_a_multiple_of_the_weight_between_two_bounds():
    settings = dict(budget_per_weight=4.0, least_budget=2.0)
    assert budget(1.5, **settings) == pytest.approx(6.0)
    assert budget(0.1, **settings) == pytest.approx(2.0)
    assert budget(3.0, **settings) == pytest.approx(8.0)
    assert budget(0.1, 1.5, **settings) == pytest.approx(1.5)


def test_what_weighs_nobody_knows_how_much_or_is_not_to_matter_has_all_of_it():
    assert budget(0.0) == budget(0.1, budget_per_weight=0.0) == pytest.approx(8.0)
    many = jax.vmap(lambda weight: budget_for(weight, 8.0, GrasperConfig()))
    assert many(jnp.zeros(3)).tolist() == [8.0] * 3
