"""The least force that holds a load: closed forms, laws, and a linear programme as the oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from mjx_grasp.grasp.wrench_margin import (
    ContactConfig,
    Load,
    about_holding_force,
    holding_force,
)

CONFIG = ContactConfig(friction=0.8, torsion=0.02)
seeds = st.integers(0, 10_000)
few = settings(max_examples=15)


@jax.jit
def force(contact, inward, load, point):
    return holding_force(contact, inward, Load(load, point), CONFIG)


@jax.jit
def on_less_friction(contact, inward, load, point):
    return holding_force(contact, inward, Load(load, point), ContactConfig(0.4, CONFIG.torsion))


batched = jax.vmap(force)


def pair(half=0.03, apart=0.02):
    """A thumb at −x, against it two wraps that are apart along y."""
    contact = np.array([[-half, 0, 0], [half, apart, 0], [half, -apart, 0]], np.float32)
    return contact, np.array([[1, 0, 0], [-1, 0, 0], [-1, 0, 0]], np.float32)


def some(seed, count=1):
    """Grasps about like those of the hand, in any orientation, with the load off their middle."""
    rng = np.random.default_rng(seed)
    grasps = []
    for _ in range(count):
        contact, inward = pair(rng.uniform(0.015, 0.045))
        contact = contact + 0.004 * rng.normal(size=(3, 3))
        inward = inward + 0.25 * rng.normal(size=(3, 3))
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        turn = Rotation.random(random_state=rng).as_matrix()
        point = turn @ (0.015 * rng.normal(size=3))
        grasps.append((contact @ turn.T, inward @ turn.T, rng.normal(size=3), point))
    return [np.float32(column) for column in zip(*grasps, strict=True)]


def by_linear_programme(contact, inward, load, point, rings=20):
    """The same with the cones replaced by polyhedra within them: a little more force."""
    ring = np.linspace(0, np.pi, rings + 1)
    edges = [
        (np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a))
        for a in ring
        for b in np.linspace(0, 2 * np.pi, max(1, round(2 * rings * np.sin(a))), endpoint=False)
    ]
    columns, owner = [], []
    for i, (p, n) in enumerate(zip(contact, inward, strict=True)):
        first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        first /= np.linalg.norm(first)
        second = np.cross(n, first)
        for x, y, z in edges:
            push = n + CONFIG.friction * (x * first + y * second)
            torque = np.cross(p - point, push) + CONFIG.torsion * z * n
            columns.append([*push, *(30 * torque)])
            owner.append(i)
    count = len(columns)
    most = np.concatenate([np.equal.outer(range(3), owner), -np.ones((3, 1))], axis=1)
    balance = np.concatenate([np.transpose(columns), np.zeros((6, 1))], axis=1)
    found = linprog(
        np.eye(count + 1)[-1], A_ub=most, b_ub=np.zeros(3), A_eq=balance, b_eq=[*-load, 0, 0, 0]
    )
    return found.fun if found.status == 0 else np.inf


def test_opposite_contacts_hold_by_friction_on_both_sides():
    held = force(*pair(), np.float32([0, 0, -5]), np.zeros(3, np.float32))
    assert held == pytest.approx(5 / (2 * CONFIG.friction), rel=5e-3)


@pytest.mark.parametrize(("load", "expected"), [([5, 0, 0], 2.5), ([-5, 0, 0], 5.0)])
def test_along_the_normals_two_fingers_carry_a_load_or_one_does(load, expected):
    assert force(*pair(), np.float32(load), np.zeros(3, np.float32)) == pytest.approx(
        expected, rel=5e-3
    )


@pytest.mark.long
def test_a_lever_costs_force_and_torsion_spares_some():
    contact, inward = pair()
    load, point = np.float32([0, 0, -5]), np.float32([0, 0.04, 0])
    near = force(contact, inward, load, np.zeros(3, np.float32))
    far = force(contact, inward, load, point)
    assert far > 1.5 * near
    slippery = ContactConfig(friction=0.8, torsion=0.0)
    assert holding_force(contact, inward, Load(load, point), slippery) > 1.02 * far


def test_nothing_holds_what_the_normals_cannot_oppose():
    contact, _ = pair()
    down = np.tile(np.float32([0, 0, -1]), (3, 1))
    assert np.isinf(force(contact, down, np.float32([0, 0, -5]), np.zeros(3, np.float32)))
    assert force(contact, -down, np.float32([0, 0, -5]), np.zeros(3, np.float32)) < 5


def test_it_agrees_with_a_linear_programme():
    grasps = some(1, 40)
    found = np.asarray(batched(*grasps))
    expected = np.array(
        [by_linear_programme(*map(np.float64, g)) for g in zip(*grasps, strict=True)]
    )
    assert np.all(np.isinf(found) | (expected < np.inf))  # where it holds nothing, nothing does
    clear = expected < 20 * np.linalg.norm(grasps[2], axis=1)  # others hang on rounding
    assert clear.sum() > 25
    ratio = found[clear] / expected[clear]
    assert ratio.max() < 1.005 and ratio.min() > 0.96 and np.median(ratio) > 0.985


@few
@given(seeds, st.floats(0.1, 50.0))
def test_it_is_proportional_to_the_load(seed, times):
    contact, inward, load, point = (column[0] for column in some(seed))
    once = float(force(contact, inward, load, point))
    many = float(force(contact, inward, np.float32(times) * load, point))
    assert many == pytest.approx(times * once, rel=2e-3)


@few
@given(seeds, st.tuples(*[st.floats(-1, 1)] * 3))
def test_a_rigid_motion_changes_nothing(seed, shift):
    contact, inward, load, point = (column[0] for column in some(seed))
    R = Rotation.random(random_state=seed).as_matrix()
    still = float(force(contact, inward, load, point))
    moved = float(
        force(
            *map(np.float32, (contact @ R.T + shift, inward @ R.T, load @ R.T, R @ point + shift))
        )
    )
    if still < 10 * np.linalg.norm(load):
        assert moved == pytest.approx(still, rel=1e-2)


@few
@given(seeds)
def test_more_friction_never_asks_for_more_force(seed):
    grasp = [column[0] for column in some(seed)]
    assert float(force(*grasp)) <= 1.01 * float(on_less_friction(*grasp))


def test_batched_and_looped_agree():
    grasps = some(3, 4)
    alone = [float(force(*grasp)) for grasp in zip(*grasps, strict=True)]
    np.testing.assert_allclose(np.asarray(batched(*grasps)), alone, rtol=2e-3)


@pytest.mark.long
def test_compiled_and_uncompiled_agree():
    contact, inward, load, point = (jnp.asarray(column[0]) for column in some(3))
    with jax.disable_jit():
        eager = float(holding_force(contact, inward, Load(load, point), CONFIG))
    assert eager == pytest.approx(float(force(contact, inward, load, point)), rel=2e-3)


def test_the_estimate_ranks_contacts_as_the_programme_does():
    """Loads across the grasp axis, as weights mostly are."""
    contact, inward, load, point = some(8, 200)
    axis = contact[:, 1:].mean(axis=1) - contact[:, 0]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    load -= np.sum(load * axis, axis=1, keepdims=True) * axis
    exact = np.asarray(batched(contact, inward, load, point))
    about = np.asarray(about_holding_force(contact, Load(load, point), CONFIG))
    holds = np.isfinite(exact) & (exact < 20 * np.linalg.norm(load, axis=1))
    ranks = [np.argsort(np.argsort(x[holds])) for x in (exact, about)]
    assert holds.sum() > 100 and np.corrcoef(*ranks)[0, 1] > 0.7


def test_the_estimate_is_exact_where_friction_alone_bears_a_load_at_the_middle():
    contact, inward = pair()
    load, point = np.float32([0, 0, -3.0]), np.zeros(3, np.float32)
    about = float(about_holding_force(contact, Load(load, point), CONFIG))
    assert about == pytest.approx(3.0 / (2 * CONFIG.friction), rel=1e-5)
    assert about == pytest.approx(float(force(contact, inward, load, point)), rel=0.02)


@few
@given(seeds, st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0.1, 50.0))
def test_the_estimate_is_proportional_and_the_same_in_every_frame(seed, shift, times):
    contact, _, load, point = (column[0] for column in some(seed))
    R, shift = Rotation.random(random_state=seed).as_matrix(), np.array(shift)
    once = float(about_holding_force(contact, Load(load, point), CONFIG))
    moved = Load(np.float32(times * load @ R.T), np.float32(R @ point + shift))
    many = float(about_holding_force(np.float32(contact @ R.T + shift), moved, CONFIG))
    assert many == pytest.approx(times * once, rel=1e-2)
