"""Contacts at which a hand can hold an object at all."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Box, Sphere
from mjx_grasp.grasp.targets import TargetOptions
from mjx_grasp.grasp.wrench_margin import ContactConfig, Load, holding_force
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.posture.touch import pressing_force
from mjx_grasp.reaching.holding import can_hold, met, opposing
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.plan_costs import FAILED, asked_of, closing_costs
from mjx_grasp.reaching.planning import held_easily

OUT = jnp.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
CONTACTS = 0.03 * OUT + jnp.array([[0.0, 0, 0], [0, 0.01, 0], [0, -0.01, 0]])
ADJACENT = OUT.at[0].set(jnp.array([0.0, 0.0, 1.0]))
"""The thumb on a face beside that of the wraps."""


def around(weight=None, com=None):
    placed = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.zeros(3), jnp.eye(3), com)
    return placed._replace(weight=None if weight is None else jnp.float32(weight))


@pytest.mark.parametrize("side", [0, 1, 2])
@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_contacts_oppose_up_to_the_angle_of_friction(side, friction):
    """One normal turned about any axis across it; both wraps turn together."""
    axis = jnp.array([0.0, np.cos(side), np.sin(side)])
    for which in ([0], [1, 2]):
        for angle, expected in ((0.98, True), (1.02, False)):
            turn = so3.exp(axis * angle * np.arctan(friction))
            normals = OUT.at[jnp.array(which)].set(OUT[jnp.array(which)] @ turn.T)
            assert bool(opposing(friction, CONTACTS, normals)) == expected
            R, p = so3.exp(jnp.array([0.4, -1.0, 0.3])), jnp.array([0.5, 0.0, 0.2])
            assert bool(opposing(friction, CONTACTS @ R.T + p, normals @ R.T)) == expected


@pytest.mark.long
def test_contacts_that_oppose_are_held_whichever_way_they_are_pulled():
    """Random normals about the line; against the friction-cone programme, from six sides.

    Not the other way round: the middle of the wraps stands for any point between them.
    """
    key, friction = jax.random.key(0), 0.6
    tilt = 0.45 * jax.random.normal(key, (60, 2, 3))
    thumb, wrap = jax.vmap(lambda t: jax.vmap(so3.exp)(t) @ jnp.array([1.0, 0, 0]))(tilt).transpose(
        1, 0, 2
    )
    normals = jnp.stack([-thumb, wrap, wrap], axis=1)
    pulls = jnp.concatenate([jnp.eye(3), -jnp.eye(3)])

    @jax.jit
    @jax.vmap
    def worst(normal):
        contact = ContactConfig(friction=friction, torsion=0.0)
        loads = [Load(pull, jnp.zeros(3)) for pull in pulls]
        return jnp.max(jnp.stack([holding_force(CONTACTS, -normal, x, contact) for x in loads]))

    opposed = np.asarray(opposing(friction, jnp.broadcast_to(CONTACTS, normals.shape), normals))
    held = np.isfinite(np.asarray(worst(normals)))
    assert 5 < opposed.sum() < 55
    assert np.all(held[opposed]) and np.mean(opposed == held) > 0.85 and not held.all()


def test_across_a_thin_wall_they_need_not_lie_opposite():
    """The thumb higher than the wraps, farther than friction would allow."""
    friction = 0.5
    thin = jnp.array([[0.0, 0.0, 0.015], [0.003, 0.02, 0.0], [0.003, -0.02, 0.0]])
    assert opposing(friction, thin, OUT)
    assert not opposing(friction, thin.at[0, 2].set(0.025), OUT), "beyond the fingertips"
    thick = thin.at[1:, 0].set(0.019)  # 24 mm apart, and 38° off
    assert not opposing(friction, thick, OUT)
    assert not opposing(friction, thin, ADJACENT)
    same_side = OUT.at[0].set(OUT[1])
    assert not opposing(friction, thin, same_side)


def test_wraps_meet_a_wall_up_to_its_edge():
    """A plate of 6 mm, 80 by 60; the wraps on +x, closing along −x."""
    plate = Box(jnp.array([0.003, 0.04, 0.03]))

    def meet(y=0.0, z=0.0, x=0.003):
        contacts = jnp.array([[-0.003, 0, 0], [x, y + 0.02, z], [x, y - 0.02, z]])
        return bool(met(plate, contacts, OUT))

    assert meet() and meet(z=0.03) and meet(y=-0.02)
    assert not meet(z=0.036) and not meet(y=0.026) and not meet(z=-0.036)
    # The target may be before or behind the surface: the finger goes on until it meets it.
    assert meet(x=0.020) and meet(x=-0.006) and not meet(x=0.045)
    many = jnp.stack([jnp.zeros((3, 3)), jnp.full((3, 3), 0.2)])
    np.testing.assert_array_equal(met(plate, many, OUT[None]), [True, False])


def test_plans_are_for_contacts_that_fingers_meet_as_long_as_there_are_any():
    plate = Surroundings.still(Box(jnp.array([0.003, 0.04, 0.03])), jnp.zeros(3), jnp.eye(3))
    at = jnp.array([[-0.003, 0, 0], [0.003, 0.02, 0], [0.003, -0.02, 0]])
    past = at.at[1:, 2].set(0.034).at[0, 2].set(0.029)  # beyond the rim
    position, normal = jnp.stack([at, past, at]), jnp.stack([OUT, OUT, ADJACENT])
    along = jnp.tile(jnp.array([0.0, 1.0, 0.0]), (3, 1))
    ones = jnp.ones(3, bool)
    options = TargetOptions(np.arange(3), np.zeros(3, int), along, position, normal, ones)
    plan = PlanConfig(must_hold=0.5)

    def looked_for(*usable):
        return np.asarray(held_easily(plan, options, jnp.array(usable), plate)).tolist()

    assert looked_for(True, True, True) == [True, False, False]
    assert looked_for(False, True, True) == [False, True, False], "better than none"
    assert looked_for(False, False, True) == [False] * 3
    every = np.asarray(held_easily(PlanConfig(), options, ones, plate))
    assert every.all(), "it is not looked at"


def test_a_hand_holds_what_its_thumb_can_press_for(body):
    q, friction = jnp.asarray(body.home), 0.5
    holds = jax.jit(lambda normals, w: can_hold(body, friction, q, CONTACTS, normals, around(w)))
    share = float(
        holding_force(
            CONTACTS,
            -OUT,
            Load(np.array([0, 0, -1.0]), np.zeros(3)),
            ContactConfig(friction=friction),
        )
    )
    most = float(pressing_force(body, q, -OUT)[0]) / share
    assert holds(OUT, 0.99 * most) and not holds(OUT, 1.01 * most)
    assert holds(OUT, 0.0) and holds(OUT, None)
    assert not holds(ADJACENT, None) and not holds(ADJACENT, 0.0) and not holds(ADJACENT, 1.0)
    assert can_hold(body, float("inf"), q, CONTACTS, ADJACENT, around(1e3))
    # Of a centre of mass far beside them the same contacts hold less.
    beside = around(0.9 * most, jnp.array([0.0, 0.06, 0.0]))
    assert not can_hold(body, friction, q, CONTACTS, OUT, beside)


@pytest.mark.long
def test_attempts_that_cannot_hold_have_failed(body):
    q, contacts = jnp.asarray(body.home)[None], CONTACTS[None]

    def cost(must_hold, normals, weight):
        plan = PlanConfig(must_hold=must_hold)
        given = contacts, normals[None]
        asked = asked_of(plan, *given, around(weight))
        return float(closing_costs(body, plan, q, *given, asked, around(weight))[0])

    never, held = partial(cost, float("inf")), partial(cost, 0.8)
    assert held(OUT, None) == never(OUT, None) == never(ADJACENT, None) == 0.0
    assert held(ADJACENT, None) >= FAILED and held(OUT, 1e3) >= FAILED
    free = replace(body, torque_limit=np.full_like(body.torque_limit, np.inf))
    plan = PlanConfig(must_hold=0.8)
    asked = asked_of(plan, contacts, OUT[None], around(1e3))
    assert float(closing_costs(free, plan, q, contacts, OUT[None], asked, around(1e3))[0]) == 0.0
