"""Laws of how a policy is held to its force budget: of what it is told, tick by tick."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import CloserConfig, StageConfig
from mjx_grasp.closing.learned import KeepingConfig, told
from mjx_grasp.errors import InputError
from mjx_grasp.learning.controller import deployed_task, policy_task
from mjx_grasp.learning.policy import load_policy

DT, BUDGET = 0.01, 3.0
KEPT = KeepingConfig(gain=3.0)


@pytest.fixture(scope="module")
def lifted(robot, starts):
    """A closer's state after so many ticks of the lift with that mean force; None: before it."""
    measured, targets = jax.tree.map(lambda rows: rows[0], (starts.measured, starts.targets))
    begun = Closer.of(robot).start(measured, targets)

    def state(ticks: int | None, force: float):
        if ticks is None:
            return begun
        summed = jnp.float32(force * ticks)
        lift_tick = jnp.int32(ticks - 1)
        return begun._replace(lifting=jnp.asarray(True), lift_tick=lift_tick, pressed=summed)

    return state


def test_what_is_spent_is_the_mean_of_the_estimated_forces_since_lift_onset(robot, starts):
    measured, targets = jax.tree.map(lambda rows: rows[0], (starts.measured, starts.targets))
    closer = Closer.of(robot, CloserConfig(stages=StageConfig(acquisition_s=0.05)))
    sense, act = jax.jit(closer.sense), jax.jit(closer.act)
    state, rng, spent, ticks = closer.start(measured, targets), np.random.default_rng(0), 0.0, 0
    for tick in range(12):
        torque = rng.normal(size=measured.external_torque.shape).astype(np.float32) * 0.1
        now = measured._replace(external_torque=torque)
        state = sense(state, now, targets, np.full(3, tick >= 4))
        if state.lifting:
            spent += float(jnp.linalg.norm(closer.forces(state, now), axis=-1).mean())
            ticks += 1
        np.testing.assert_allclose(state.pressed, spent, rtol=1e-4)
        state, _ = act(state, now, targets, np.zeros(closer.action_size, np.float32))
    assert ticks == state.lift_tick + 1 == 8 and spent > 1.0


def test_a_policy_at_work_is_held_to_its_budget_and_in_training_told_it():
    policy = load_policy(asset_path("policy.npz"))
    trained, deployed = policy_task(policy), deployed_task(policy)
    assert trained.observation.keeping.gain == 0.0 < deployed.observation.keeping.gain
    assert deployed_task(policy, keeping_gain=0.0) == trained
    noise = policy.meta["noise"] | {"budget_n": [2.0, 6.0]}
    other = deployed_task(replace(policy, meta=policy.meta | {"noise": noise})).observation.keeping
    assert (other.least, other.most) == (2.0, 6.0), "never beyond its training"


forces = st.floats(0.0, 40.0)
times = st.one_of(st.none(), st.integers(1, 100_000))


@given(times, forces)
def test_without_a_gain_it_is_told_the_budget_itself(lifted, ticks, force):
    for budget in (0.3, BUDGET, 50.0):  # beyond the bounds too
        assert told(jnp.float32(budget), lifted(ticks, force), DT, KeepingConfig()) == jnp.float32(
            budget
        )


def test_before_the_lift_it_is_told_the_budget_itself(lifted):
    assert told(jnp.float32(BUDGET), lifted(None, 0.0), DT, KEPT) == BUDGET


@given(times, forces)
def test_it_is_told_no_less_and_no_more_than_the_bounds(lifted, ticks, force):
    found = told(jnp.float32(BUDGET), lifted(ticks, force), DT, KEPT)
    assert KEPT.least <= found <= KEPT.most


@given(st.integers(1, 500), forces)
def test_after_as_much_as_its_share_of_the_budget_it_is_told_the_budget(lifted, ticks, force):
    """And more after less, less after more."""
    found = float(told(jnp.float32(BUDGET), lifted(ticks, force), DT, KEPT))
    even = float(told(jnp.float32(BUDGET), lifted(ticks, KEPT.share * BUDGET), DT, KEPT))
    assert even == pytest.approx(BUDGET, rel=1e-4)
    assert (found - BUDGET) * (KEPT.share * BUDGET - force) >= -1e-3


def test_its_logarithm_moves_with_what_is_spared_as_fast_as_the_gain_says(lifted):
    """d/dt log B̂ = g (s − F/B), by differences of two ticks."""
    for force in (1.5, 2.6, 3.1):
        one, other = (
            float(told(jnp.float32(BUDGET), lifted(ticks, force), DT, KEPT)) for ticks in (20, 21)
        )
        expected = KEPT.gain * (KEPT.share - force / BUDGET)
        assert (np.log(other) - np.log(one)) / DT == pytest.approx(expected, abs=2e-3)


def test_a_grip_that_obeys_ends_within_its_budget(lifted):
    """A plant whose force is told times a factor, as heavy objects ask for: the mean settles."""
    for factor in (0.7, 1.0, 1.6):
        total, state = 0.0, lifted(None, 0.0)
        for tick in range(1, 601):
            force = factor * float(told(jnp.float32(BUDGET), state, DT, KEPT))
            total += force
            state = lifted(tick, total / tick)
        mean = total / 600
        # The integral stays off by log(factor)/g; without keeping it would be factor times B.
        offset = BUDGET * np.log(factor / KEPT.share) / (KEPT.gain * 600 * DT)
        assert mean == pytest.approx(KEPT.share * BUDGET + offset, rel=0.01)


def test_a_batch_is_the_map_over_its_robots_and_compiled_is_as_written(lifted):
    states = [lifted(ticks, force) for ticks, force in ((None, 0.0), (50, 2.0), (200, 3.4))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    budgets = jnp.array([1.5, 3.0, 6.0])
    singly = [told(b, state, DT, KEPT) for b, state in zip(budgets, states, strict=True)]
    law = partial(told, dt=DT, config=KEPT)
    np.testing.assert_allclose(law(budgets, stacked), singly, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(law)(budgets, stacked), singly, rtol=1e-5)


def test_bounds_in_the_wrong_order_are_refused():
    with pytest.raises(InputError, match=r"least: found 13.*at most `most` \(12\)"):
        KeepingConfig(least=13.0)
