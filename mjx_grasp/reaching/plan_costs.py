"""What the attempts of a search cost, in time: the way there, and what they lack.

An attempt may lack a solution, a straight lift or a closing finger after it, or contacts that hold.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.geometry.vectors import norm, unit
from mjx_grasp.grasp.wrench_margin import (
    ContactConfig,
    about_holding_force,
    holding_forces,
)
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.ik import IkSolution
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.posture.surroundings import Surroundings, to_object
from mjx_grasp.posture.touch import pad_angles, pressing_force, touching
from mjx_grasp.reaching.approach import deviation
from mjx_grasp.reaching.fields import midpoint
from mjx_grasp.reaching.holding import can_press, pull
from mjx_grasp.reaching.plan_config import PlanConfig

FAILED = 1e4
"""Cost of an attempt that is none [s]."""
# Cost of a metre of tip error or missing clearance [s/m].
_LACKING = 1e3
# Points of a circle around a contact.
_CIRCLE = 12


def attempt_costs(
    body: Body,
    plan: PlanConfig,
    admissible: Bool[Array, " n"],
    found: IkSolution,
    q: Float[Array, " joints"],
) -> Float[Array, " n"]:
    """Of solutions: time to get there at full speed, by haste, and heavily what they lack [s].

    Args:
        body: The robot.
        plan: The search's settings.
        admissible: Whether each one's contacts may be used at all.
        found: Solutions.
        q: Present configuration [rad].
    """
    time = jnp.max(jnp.abs(found.q - q) / body.velocity_limit, axis=1)
    error = jnp.max(found.error, axis=1)
    lacking = jnp.maximum(jnp.maximum(error - plan.tolerance, found.missing), 0.0)
    return jnp.where(admissible, plan.haste * time + _LACKING * lacking, FAILED)


class Asked(NamedTuple):
    """Force of the thumb that contacts ask for to hold the object, by its weight [-].

    With one friction after the other of the search's settings; +inf where no force is enough.
    """

    to_hold: Float[Array, " n"]
    to_press: Float[Array, " n"]
    to_count: Float[Array, " n"]
    """with that with which they must hold it; anything where that is not looked at"""


def asked_of(
    plan: PlanConfig,
    contacts: Float[Array, "n 3 3"],
    normals: Float[Array, "n 3 3"],
    around: Surroundings,
) -> Asked:
    """What contacts ask for.

    Args:
        plan: The search's settings.
        contacts: Thumb, index and middle, world [m].
        normals: Outward unit normals of the surface there, world [-].
        around: The object.
    """
    must = plan.must_hold if np.isfinite(plan.must_hold) else plan.hold_friction
    kinds = [ContactConfig(friction=f) for f in (plan.hold_friction, plan.press_friction, must)]
    load = pull(around, 1.0)
    forces = jax.vmap(lambda at, n: holding_forces(at, -n, load, kinds))(contacts, normals)
    return Asked(*forces.T)


def closing_costs(
    body: Body,
    plan: PlanConfig,
    q: Float[Array, "n joints"],
    contacts: Float[Array, "n 3 3"],
    normals: Float[Array, "n 3 3"],
    asked: Asked,
    around: Surroundings,
) -> Float[Array, " n"]:
    """What postures lack in their approach, and for closing, pressing and lifting after them [s].

    Those whose contacts cannot hold the object are `FAILED`, if that is looked at.

    Args:
        body: The robot.
        plan: The search's settings.
        q: Postures in front of the contacts [rad].
        contacts: Thumb, index and middle, world [m].
        normals: Outward unit normals of the surface there, world [-].
        asked: What the contacts ask for, from `asked_of`.
        around: Object and obstacles.
    """
    lacking = late = jnp.zeros(len(q))
    if plan.approach != "any":
        off = jax.vmap(lambda q: deviation(body, q, plan.approach))(q)
        lacking = plan.lever * jnp.maximum(off - plan.approach_angle, 0.0)
    if np.isfinite(plan.lift_error):
        lift = jax.vmap(lambda q: scripted_lift(body, q, plan.lift_height).error)(q)
        lacking = lacking + jnp.maximum(lift - plan.lift_error, 0.0)
    weight = around.weight if plan.press_weight > 0 else None
    looks = np.isfinite(plan.touch_error) or np.isfinite(plan.must_hold) or plan.pad_weight > 0
    if weight is None and not looks:
        return _LACKING * lacking
    closed = jax.vmap(lambda q, at: touching(body, q, at))(q, contacts)
    if np.isfinite(plan.touch_error):
        touch = jnp.max(closed.error, axis=1)
        lacking = lacking + jnp.maximum(touch - plan.touch_error, 0.0)
        late = plan.touch_weight * touch
    if plan.pad_weight > 0:
        turned = jax.vmap(lambda q, n: pad_angles(body, q, n))(closed.q, normals)
        late = late + plan.pad_weight * jnp.maximum(jnp.max(turned, axis=1) - plan.pad_angle, 0.0)
    if weight is not None:
        late = late + _press_costs(body, plan, closed.q, normals, asked.to_press, weight)
    if np.isfinite(plan.must_hold):
        holds = jax.vmap(partial(can_press, body, around=around))
        late = jnp.where(holds(asked.to_count, closed.q, normals), late, FAILED)
    return _LACKING * lacking + late


def light_enough(
    plan: PlanConfig,
    heavier: float,
    admissible: Bool[Array, " v"],
    contacts: Float[Array, "v 3 3"],
    around: Surroundings,
) -> Bool[Array, " v"]:
    """Which contacts hold the object by not much more force than the best of them.

    Args:
        plan: The search's settings.
        heavier: How many times that force may be; with infinitely many all are.
        admissible: Which may be used at all.
        contacts: Thumb, index and middle, world [m].
        around: Object and obstacles.
    """
    if not np.isfinite(heavier):
        return jnp.ones(len(contacts), bool)
    contact = ContactConfig(friction=plan.press_friction)
    force = about_holding_force(contacts, pull(around, 1.0), contact)
    return force <= heavier * jnp.min(jnp.where(admissible, force, jnp.inf))


def slip_costs(
    plan: PlanConfig,
    contacts: Float[Array, "n 3 3"],
    normals: Float[Array, "n 3 3"],
    asked: Asked,
    around: Surroundings,
) -> Float[Array, " n"]:
    """What contacts lack that the object is likely to slip out of [s].

    Args:
        plan: The search's settings.
        contacts: Thumb, index and middle, world [m].
        normals: Outward unit normals of the surface there, world [-].
        asked: What the contacts ask for, from `asked_of`.
        around: Object and obstacles.
    """
    lacking = jnp.zeros(len(contacts))
    if plan.hold_weight > 0:
        # The thumb bears half the weight, and of walls that stand upright by friction alone.
        excess = jnp.minimum(asked.to_hold, plan.hold_most) - 0.5 / plan.hold_friction
        lacking = lacking + plan.hold_weight * jnp.maximum(excess, 0.0)
    if plan.lever_weight > 0:
        beside = jax.vmap(midpoint)(contacts) - pull(around, 1.0).point
        lacking = lacking + plan.lever_weight * norm(beside.at[:, 2].set(0.0))
    if plan.edge_weight > 0:
        circle = circles(contacts, normals, plan.edge_radius)
        falls = signed_distance(around.shape, to_object(around, circle))
        lacking = lacking + plan.edge_weight * jnp.max(falls, axis=(1, 2), initial=0.0)
    return lacking


def _press_costs(
    body: Body,
    plan: PlanConfig,
    q: Float[Array, "n joints"],
    normals: Float[Array, "n 3 3"],
    share: Float[Array, " n"],
    weight: Float[Array, ""],
) -> Float[Array, " n"]:
    """What the thumb lacks to press as hard as contacts ask for to hold the known weight [s]."""
    pressed = jax.vmap(lambda q, normal: pressing_force(body, q, -normal)[0])(q, normals)
    lacking = jnp.maximum(jnp.where(weight > 0, weight * share, 0.0) - pressed, 0.0)
    # Contacts that cannot hold it at all count as asking for a finite force.
    return plan.press_weight * jnp.minimum(lacking, plan.hold_most * weight)


def circles(
    centre: Float[Array, "*n 3"], normal: Float[Array, "*n 3"], radius: float
) -> Float[Array, "*n points 3"]:
    """Points around centres, evenly on circles across unit normals, [m]."""
    least = jnp.eye(3)[jnp.argmin(jnp.abs(normal), axis=-1)]
    across = unit(jnp.cross(normal, least))
    other = jnp.cross(normal, across)
    angle = jnp.linspace(0.0, 2 * jnp.pi, _CIRCLE, endpoint=False)[:, None]
    ways = jnp.cos(angle) * across[..., None, :] + jnp.sin(angle) * other[..., None, :]
    return centre[..., None, :] + radius * ways
