from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.closing.config import ObserverConfig
from mjx_grasp.closing.observer import ObserverState, initial_observer, observe
from mjx_grasp.errors import InputError

CONFIG = ObserverConfig()
LIMITS = np.tile(np.array([-1.0, 1.0], np.float32), (9, 1))
DRY = np.full(9, 0.01, np.float32)
MIDDLE, REST = jnp.zeros(9), jnp.zeros(9)


@partial(jax.jit, static_argnames=("dt", "config"))
def ticked(state, residual, q, qd, dt, config):
    """Compiled once for each number of steps; the laws of batches and of gains ask it as it is."""
    return observe(state, residual, q, qd, LIMITS, DRY, dt, config)


def run(residual, ticks, config=CONFIG, q=MIDDLE, qd=REST, state=None):
    """Observer after `ticks` ticks of five physics steps with the same residual."""
    state = state or initial_observer((), 9, 3)
    residual = jnp.broadcast_to(jnp.asarray(residual, jnp.float32), (5, 9))
    touching = None
    for _ in range(ticks):
        state, touching = ticked(state, residual, q, qd, 5 * 0.002, config)
    return state, np.asarray(touching)


@pytest.mark.wrong_types
def test_torques_of_other_joints_are_refused():
    with pytest.raises(InputError, match="external_torque: found '8 columns', expected 9"):
        observe(
            initial_observer((), 9, 3), jnp.zeros((5, 8)), MIDDLE, REST, LIMITS, DRY, 0.01, CONFIG
        )


@pytest.mark.parametrize("ticks", [1, 2, 5, 20])
def test_estimate_converges_exponentially_at_rate_k(ticks):
    torque = np.linspace(-0.3, 0.3, 9)
    state, _ = run(torque, ticks)
    # τ̂' = K(τ − τ̂) over the time that passed; the steps are implicit, hence first order.
    expected = torque * (1 - np.exp(-50 * 0.01 * ticks))
    np.testing.assert_allclose(state.torque, expected, atol=0.02 * 0.3)
    exact = torque * (1 - (1 + 50 * 0.002) ** (-5.0 * ticks))
    np.testing.assert_allclose(state.torque, exact, atol=1e-6)


@given(gain=st.floats(1e-3, 1e6), seed=st.integers(0, 2**31))
def test_estimate_is_stable_for_every_gain(gain, seed):
    rng = np.random.default_rng(seed)
    config = ObserverConfig(gain=gain)
    residual = jnp.asarray(rng.uniform(-1, 1, (200, 9)), jnp.float32)
    state, _ = observe(
        initial_observer((), 9, 3), residual, MIDDLE, REST, LIMITS, DRY, 200 * 0.002, config
    )
    # A convex combination of what it saw and zero.
    assert np.abs(state.torque).max() <= np.abs(residual).max() * (1 + 1e-5)


def test_estimate_forgets():
    state, _ = run(0.3, 50)
    state, touching = run(0.0, 50, state=state)
    assert np.abs(state.torque).max() < 1e-6 and not touching.any()


@pytest.mark.parametrize("finger", range(3))
def test_one_loaded_joint_flags_its_own_finger_after_three_ticks(finger):
    for joint in range(3):
        residual = np.zeros(9)
        residual[3 * finger + joint] = -0.5
        assert not run(residual, 2)[1].any()
        np.testing.assert_array_equal(run(residual, 3)[1], np.arange(3) == finger)


def test_moving_finger_does_not_touch_and_starts_the_count_anew():
    qd = REST.at[4].set(0.11)  # index
    np.testing.assert_array_equal(run(0.5, 10, qd=qd)[1], [True, False, True])
    assert run(0.5, 10, qd=REST.at[4].set(-0.11))[1].tolist() == [True, False, True]
    assert run(0.5, 10, qd=REST.at[4].set(0.09))[1].all()
    state, _ = run(0.5, 2)
    state, _ = run(0.5, 1, qd=qd, state=state)
    np.testing.assert_array_equal(state.ticks, [3, 0, 3])
    assert run(0.5, 2, state=state)[1].tolist() == [True, False, True]


def test_threshold_is_beyond_dry_friction():
    assert not run(0.0399, 200)[1].any()
    assert run(0.0401, 200)[1].all()
    assert not run(-0.0399, 200)[1].any()
    assert run(-0.0401, 200)[1].all()


@pytest.mark.parametrize("place, counts", [(0.96, True), (0.98, False), (-0.98, False)])
def test_joints_at_a_stop_are_left_out(place, counts):
    residual = np.zeros(9)
    residual[0] = 0.5
    touching = run(residual, 5, q=MIDDLE.at[0].set(place))[1]
    assert bool(touching[0]) == counts


def test_batch_agrees_with_single_worlds():
    rng = np.random.default_rng(0)
    residual = jnp.asarray(rng.normal(size=(4, 5, 9)), jnp.float32)
    q = jnp.asarray(rng.uniform(-1, 1, (4, 9)), jnp.float32)
    qd = jnp.asarray(rng.uniform(-0.2, 0.2, (4, 9)), jnp.float32)
    state = ObserverState(jnp.asarray(rng.normal(size=(4, 9)), jnp.float32), jnp.full((4, 3), 2))
    call = lambda s, r, a, b: observe(s, r, a, b, LIMITS, DRY, 5 * 0.002, CONFIG)  # noqa: E731
    batch = call(state, residual, q, qd)
    for w in range(4):
        one = call(jax.tree.map(lambda x, w=w: x[w], state), residual[w], q[w], qd[w])
        jax.tree.map(lambda a, b, w=w: np.testing.assert_allclose(a[w], b, rtol=1e-6), batch, one)


def test_agrees_with_the_momentum_form_on_a_pendulum():
    """r⁺ = [r + K·(M⁺(v⁺ − v) + dt·(c − τ))]/(1 + K·dt) on a joint with known gravity and load."""
    inertia, load, gain, dt = 0.02, 0.07, 50.0, 0.002
    q, v, r, tau = 0.3, 0.0, 0.0, 0.1
    state = initial_observer((), 9, 3)
    for _ in range(40):
        c = 0.5 * np.sin(q)
        v_next = v + dt * (tau + load - c) / inertia
        r = (r + gain * (inertia * (v_next - v) + dt * (c - tau))) / (1 + gain * dt)
        explained = inertia * (v_next - v) / dt + c - tau
        residual = jnp.zeros((1, 9)).at[0, 0].set(explained)
        state, _ = ticked(state, residual, MIDDLE, REST, dt, CONFIG)
        q, v = q + dt * v_next, v_next
    np.testing.assert_allclose(state.torque[0], r, rtol=1e-4)
    np.testing.assert_allclose(r, load * (1 - 1.1**-40), rtol=1e-4)
