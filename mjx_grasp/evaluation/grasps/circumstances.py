"""What a scenario does to each trial: headings and obstacles as drawn, forces as they act.

All is numbers of a compiled function, world by world, so that scenarios share one, and a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.evaluation.grasps.tracker import Faults
from mjx_grasp.geometry.vectors import norm, unit
from mjx_grasp.objects.model import GRAVITY

_BELT_GAIN = 40.0
"""How fast a belt that slips takes an object along: force per mass and missing speed [1/s]."""
_ON_THE_TABLE_M = 0.005
"""Rise up to which an object is carried by the table."""


class Belt(NamedTuple):
    """A `BeltConfig` with its headings."""

    velocity: Float[Array, "w 3"]
    """[m/s]"""
    starts_s: Float[Array, " w"]
    when_near: Float[Array, " w"]
    lasts_s: Float[Array, " w"]


class Push(NamedTuple):
    """A `PushConfig` with its directions."""

    force: Float[Array, "w 3"]
    """[N]"""
    after_s: Float[Array, " w"]
    lasts_s: Float[Array, " w"]


class Circumstances(NamedTuple):
    """Of all trials; world frame."""

    mass: Float[Array, " w"]
    """true mass of the object [kg]"""
    mass_scale: Float[Array, " w"]
    """by how much it is more than the catalogue has it [-]"""
    weighed: Bool[Array, " w"]
    """whether the controller knows the weight, as the catalogue has it"""
    friction: Float[Array, " w"]
    """of an object on the table [-]"""
    hold_s: Float[Array, " w"]
    """time at the top after which a trial may end [s]"""
    belt: Belt
    push: Push
    faults: Faults
    """of the tracker"""
    told: Bool[Array, " w"]
    """whether fingertips tell what they touch"""
    obstacles: Float[Array, "w k 4"]
    """spheres: centre and radius [m]"""


def circumstances(
    scenario: Scenario,
    p_wo: Float[np.ndarray, "w 3"],
    headings: Float[np.ndarray, "w 2"],
    mass: Float[np.ndarray, " w"],
    friction: float,
    tips: Float[np.ndarray, " 3"],
    dt: float,
) -> Circumstances:
    """What a scenario is in each trial.

    Args:
        scenario: What happens.
        p_wo: Object origins at the start [m].
        headings: `GraspProblem.headings` [rad].
        mass: As the catalogue has it [kg].
        friction: Of an object on the table [-].
        tips: Midpoint of the fingertips at home [m].
        dt: Control period [s].
    """
    angles = headings.T
    carried, pushed = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    belt, push = scenario.belt, scenario.push
    if belt.heading == "across":
        carried = np.where(p_wo[:, 1:2] > 0, -1.0, 1.0) * np.array([0.0, 1.0, 0.0])
    balls = np.zeros((len(p_wo), len(scenario.obstacles), 4))
    for k, ball in enumerate(scenario.obstacles):
        way = p_wo - tips
        length = np.linalg.norm(way, axis=1, keepdims=True)
        along = np.minimum(ball.along * length, length - ball.clear)
        balls[:, k, :3] = tips + along * way / length
        balls[:, k, 3] = ball.radius

    def each(x: ArrayLike) -> Array:
        """Numbers of the worlds, or one for all of them."""
        return jnp.asarray(np.broadcast_to(np.asarray(x, np.float32), len(p_wo)))

    faults = Faults.of(scenario.tracker, dt)
    return Circumstances(
        mass=each(scenario.mass_scale * mass),
        mass_scale=each(scenario.mass_scale),
        weighed=jnp.full(len(p_wo), scenario.weighed),
        friction=each(friction),
        hold_s=each(scenario.hold_s),
        belt=Belt(
            jnp.asarray(belt.speed * carried, jnp.float32),
            *map(each, (belt.starts_s, belt.when_near, belt.lasts_s)),
        ),
        push=Push(
            jnp.asarray(push.force * pushed, jnp.float32),
            *map(each, (push.after_s, push.lasts_s)),
        ),
        faults=Faults(*(jnp.repeat(x, len(p_wo)) for x in faults)),
        told=jnp.full(len(p_wo), scenario.told),
        obstacles=jnp.asarray(balls, jnp.float32),
    )


def belt_wrench(
    given: Circumstances,
    velocity: Float[Array, "w 3"],
    rise: Float[Array, " w"],
    com_height: Float[Array, " w"],
    since: Float[Array, " w"],
) -> Float[Array, "w 6"]:
    """What makes a still table act on the object as a moving belt would, about its centre of mass.

    Where object and table meet, μ m g along the belt cancels what the still table takes from an
    object that goes with it, and up to as much drags towards the belt's velocity one that does not.
    An object that has fallen off the table is left alone.

    Args:
        given: Of the trials.
        velocity: Of the object [m/s].
        rise: Since the start [m].
        com_height: Of the centre of mass above the table [m].
        since: Time since the belt began to move, negative before [s].
    """
    belt, mass = given.belt, given.mass
    moving = (since >= 0) & (since < belt.lasts_s) & (rise < _ON_THE_TABLE_M)
    moving &= (com_height > 0.0) & jnp.any(belt.velocity != 0.0, axis=-1)
    most = given.friction * mass * GRAVITY
    missing = (belt.velocity - velocity).at[:, 2].set(0.0)
    wanted = _BELT_GAIN * mass[:, None] * missing
    share = jnp.minimum(1.0, most / jnp.maximum(norm(wanted), 1e-9))
    force = most[:, None] * unit(belt.velocity) + share[:, None] * wanted
    down = jnp.zeros_like(force).at[:, 2].set(-com_height)
    wrench = jnp.concatenate([force, jnp.cross(down, force)], axis=-1)
    return jnp.where(moving[:, None], wrench, 0.0)


def belt_start(
    began: Float[Array, " w"],
    clock: Float[Array, " w"],
    tip_error: Float[Array, "w 3"],
    belt: Belt,
) -> Float[Array, " w"]:
    """When the belt of each trial began to move; +inf as long as it has not [s].

    Args:
        began: As of the tick before.
        clock: Now [s].
        tip_error: Of the fingertips to their targets [m].
        belt: When it is to begin.
    """
    near = jnp.max(tip_error, axis=-1) <= belt.when_near
    return jnp.where(jnp.isinf(began) & (clock >= belt.starts_s) & near, clock, began)


def push_wrench(given: Circumstances, held: Float[Array, " w"]) -> Float[Array, "w 6"]:
    """The push in the hand, at the centre of mass: force [N], no torque.

    Args:
        given: Of the trials.
        held: Time since the end of the lift, NaN where it is not held [s].
    """
    push = given.push
    acts = (held >= push.after_s) & (held < push.after_s + push.lasts_s)
    force = jnp.where(acts[:, None], push.force, 0.0)
    return jnp.concatenate([force, jnp.zeros_like(force)], axis=-1)
