"""Laws of fingertip forces from joint torques, and of the grip that answers to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_grasp.closing.config import REACTING, ForceConfig, GripConfig
from mjx_grasp.closing.forces import (
    finger_shares,
    next_level,
    press_directions,
    pressing_and_sliding,
    tip_forces,
)

OUT = jnp.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
CONTACTS = 0.03 * OUT + jnp.array([[0.0, 0, 0], [0, 0.02, 0], [0, -0.02, 0]])

DT = 0.01
seeds = st.integers(0, 2**31 - 1)


def fingers(seed, batch=()):
    """Jacobians with levers of a hand's size, none of them near a singular posture."""
    rng = np.random.default_rng(seed)
    u, _ = np.linalg.qr(rng.normal(size=(*batch, 3, 3, 3)))
    v, _ = np.linalg.qr(rng.normal(size=(*batch, 3, 3, 3)))
    linear = (u * rng.uniform(0.04, 0.1, (*batch, 3, 1, 3))) @ v
    jacobian = np.concatenate([linear, rng.normal(size=linear.shape)], axis=-2)
    return jnp.asarray(jacobian, jnp.float32), rng


def torques(jacobian, force):
    return jnp.sum(jacobian[..., :3, :] * force[..., None], axis=-2)


@given(seed=seeds)
@settings(deadline=None, max_examples=30)
def test_a_force_is_found_again_from_its_torques(seed):
    jacobian, rng = fingers(seed)
    force = jnp.asarray(rng.uniform(-5, 5, (3, 3)), jnp.float32)
    free = jnp.ones((3, 3), bool)
    config = ForceConfig(damping=1e-4)
    found = tip_forces(torques(jacobian, force), jacobian, free, config)
    np.testing.assert_allclose(found, force, atol=2e-3)


@given(seed=seeds)
@settings(deadline=None, max_examples=30)
def test_damped_forces_agree_with_numpys_least_squares(seed):
    jacobian, rng = fingers(seed)
    torque = jnp.asarray(rng.normal(size=(3, 3)) * 0.2, jnp.float32)
    free = jnp.asarray(rng.random((3, 3)) < 0.8)
    config = ForceConfig(most=1e6)
    found = tip_forces(torque, jacobian, free, config)
    for f in range(3):
        rows = np.asarray(jacobian[f, :3].T)[np.asarray(free[f])]
        a = np.concatenate([rows, config.damping * np.eye(3)])
        b = np.concatenate([np.asarray(torque[f])[np.asarray(free[f])], np.zeros(3)])
        np.testing.assert_allclose(found[f], np.linalg.lstsq(a, b)[0], atol=1e-3)


def test_a_joint_at_its_stop_says_nothing():
    jacobian, rng = fingers(1)
    torque = jnp.asarray(rng.normal(size=(3, 3)) * 0.2, jnp.float32)
    free = jnp.ones((3, 3), bool).at[1, 2].set(False)
    pushed = torque.at[1, 2].add(5.0)
    config = ForceConfig()
    np.testing.assert_array_equal(
        tip_forces(torque, jacobian, free, config), tip_forces(pushed, jacobian, free, config)
    )
    everything = jnp.ones((3, 3), bool)
    assert (tip_forces(torque, jacobian, everything, config)[1] != 0).all()


def test_a_stretched_finger_gives_no_huge_force():
    jacobian, _ = fingers(2)
    flat = jacobian.at[:, 0].set(0.0)  # no joint moves the pad along x
    torque = jnp.full((3, 3), 0.1)
    free = jnp.ones((3, 3), bool)
    found = tip_forces(torque, flat, free, ForceConfig())
    assert np.isfinite(found).all() and np.linalg.norm(found, axis=-1).max() < 10
    weak = tip_forces(1e3 * torque, jacobian, free, ForceConfig(most=12.0))
    np.testing.assert_allclose(np.linalg.norm(weak, axis=-1), 12.0, rtol=1e-4)


def test_batches_jit_and_turned_worlds_agree():
    jacobian, rng = fingers(3, batch=(4,))
    torque = jnp.asarray(rng.normal(size=(4, 3, 3)) * 0.2, jnp.float32)
    free, config = jnp.ones((4, 3, 3), bool), ForceConfig()
    found = tip_forces(torque, jacobian, free, config)
    compiled = jax.jit(tip_forces, static_argnums=3)(torque, jacobian, free, config)
    np.testing.assert_allclose(compiled, found, atol=1e-4)
    for w in range(4):
        alone = tip_forces(torque[w], jacobian[w], free[w], config)
        np.testing.assert_allclose(alone, found[w], atol=1e-4)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turned = jnp.concatenate(
        [jnp.einsum("ij,wfjk->wfik", turn, jacobian[..., :3, :]), jacobian[..., 3:, :]], axis=-2
    )
    again = tip_forces(torque, turned.astype(jnp.float32), free, config)
    np.testing.assert_allclose(again, found @ turn.T, atol=2e-3)


@given(seed=seeds)
@settings(deadline=None, max_examples=20)
def test_along_the_line_a_balanced_grip_pushes_the_object_nowhere(seed):
    rng = np.random.default_rng(seed)
    pads = jnp.asarray(rng.normal(size=(3, 3)) * 0.05, jnp.float32)
    press = press_directions(pads, CONTACTS, OUT, REACTING)
    np.testing.assert_allclose(np.linalg.norm(press, axis=-1), 1.0, atol=1e-4)
    share = finger_shares(3, REACTING)
    np.testing.assert_allclose((share[:, None] * np.asarray(press)).sum(0), 0.0, atol=1e-5)
    assert ((pads[1:].mean(0) - pads[0]) @ press[0]) > 0  # the thumb towards the others


def test_a_plain_grip_presses_evenly_against_the_normals():
    normals = jnp.eye(3)
    plain = GripConfig()
    nowhere = jnp.zeros((3, 3))
    np.testing.assert_array_equal(press_directions(nowhere, nowhere, normals, plain), -normals)
    np.testing.assert_array_equal(finger_shares(3, plain), np.ones(3))
    assert finger_shares(3, REACTING).mean() == pytest.approx(1.0)


def test_across_a_thin_wall_at_different_heights_the_fingers_press_squarely():
    """So that their forces are a couple; of many hands each for itself."""
    thin = CONTACTS.at[1:, 0].set(-0.027).at[0, 2].set(0.015)
    pads = CONTACTS + 0.01 * OUT
    many = jnp.stack([CONTACTS, thin])
    normals = jnp.broadcast_to(OUT, many.shape)
    opposite, moved = press_directions(pads + 0 * many, many, normals, REACTING)
    np.testing.assert_array_equal(opposite, press_directions(pads, CONTACTS, OUT, REACTING))
    np.testing.assert_array_equal(moved, -OUT)
    shares = finger_shares(3, REACTING)[:, None]
    np.testing.assert_allclose((shares * np.asarray(moved)).sum(axis=0), 0.0, atol=1e-6)
    torque = np.cross(np.asarray(thin), shares * np.asarray(moved)).sum(axis=0)
    np.testing.assert_allclose(torque, [0.0, 0.015 * 1.5, 0.0], atol=1e-6)
    # Not of a thick object, however far the thumb is off, nor where it is nearly opposite.
    for contacts, off in ((CONTACTS, 0.12), (thin, -0.014)):
        moved = jnp.zeros((3, 3)).at[0, 2].set(off)
        press = press_directions(pads + moved, contacts + moved, OUT, REACTING)
        assert not np.array_equal(press, -OUT)


def test_pressing_and_sliding_are_the_parts_of_a_force():
    press = jnp.array([[0.0, 0, -1], [1.0, 0, 0], [0, 1.0, 0]])
    force = jnp.array([[0.3, 0.4, 5.0], [-2.0, 0, 0], [1.0, 2.0, 0]])
    normal, tangential = pressing_and_sliding(force, press)
    np.testing.assert_allclose(normal, [5.0, 2.0, 0.0], atol=1e-6)  # none can pull
    np.testing.assert_allclose(tangential, [0.5, 0.0, 1.0], atol=1e-5)


@given(
    level=st.floats(2.5, 8.0),
    normal=st.floats(0.0, 20.0),
    tangential=st.floats(0.0, 20.0),
)
@settings(deadline=None)
def test_the_level_keeps_to_its_bounds_and_rates(level, normal, tangential):
    n, t = jnp.full(3, normal), jnp.full(3, tangential)
    after = float(next_level(jnp.float32(level), n, t, DT, REACTING))
    assert REACTING.force <= after <= REACTING.most
    assert -REACTING.fall * DT - 1e-5 <= after - level <= REACTING.rise * DT + 1e-5
    missing = tangential / REACTING.friction - normal
    if abs(missing) > 1e-3:
        assert (after - level) * missing >= 0


def test_a_steady_load_is_held_at_the_assumed_friction():
    """A tip that presses with what it is told settles where Σ n = Σ t / μ₀."""
    level, load = jnp.float32(REACTING.force), jnp.full(3, 1.8)
    for _ in range(200):
        level = next_level(level, jnp.full(3, level), load, DT, REACTING)
    assert float(level) == pytest.approx(1.8 / REACTING.friction, rel=1e-3)


def test_without_a_friction_the_level_stays():
    level = jnp.array([1.0, 3.0])
    load = jnp.full((2, 3), 9.0)
    np.testing.assert_array_equal(next_level(level, 0 * load, load, DT, GripConfig()), level)
