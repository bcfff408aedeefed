"""The reward terms of the closing task (method §5): named, weighted, each logged by its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.guidance import twist_norm
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Truth
from mjx_grasp.tasks.config import RewardConfig

_MOST_EXCESS_N = 10.0
"""A jammed hand's hundreds of newtons shall not outweigh all other grasps."""


class Moment(NamedTuple):
    """What a reward may look at: a control tick after its physics."""

    measured: Measured
    truth: Truth
    lifting: Bool[Array, "*b"]
    """the stage during the tick: contact acquisition, or the lift"""
    in_time: Bool[Array, "*b"]
    """whether the time for contact acquisition is not over"""
    guidance: Float[Array, "*b f 6"]
    """the field at the pads [m/s, rad/s]"""
    pad_twist: Float[Array, "*b f 6"]
    """how they move [m/s, rad/s]"""
    palm_velocity: Float[Array, "*b 3"]
    """[m/s]"""
    lift_speed: Float[Array, "*b"]
    """of the scripted lift [m/s]"""
    slip: Float[Array, "*b"]
    """palm-frame displacement of the object since lift onset [m]"""
    nearer: Float[Array, "*b"]
    """by how much the pads have come nearer to their contacts in the tick, mean [m]"""
    homing: Float[Array, "*b"]
    """by how much the joints have come nearer to the start state's posture [rad]"""
    lift_force: Float[Array, "*b"]
    """mean force per finger since lift onset, 0 before [N]"""
    budget: Float[Array, "*b"]
    """that this mean may be [N]"""
    action: Float[Array, "*b k"]
    last_action: Float[Array, "*b k"]
    before_last: Float[Array, "*b k"]


@dataclass(frozen=True)
class RewardTerm:
    """A name, a weight, and a function of the moment."""

    name: str
    weight: float
    value: Callable[[Moment], Float[Array, "*b"]]


def closing_terms(config: RewardConfig) -> tuple[RewardTerm, ...]:
    """The publication's terms; then, where they have a weight, of the way and of a gentle hold."""
    published = (
        RewardTerm("reach", config.reach, lambda m: jnp.where(m.lifting, 0.0, reach(m, config))),
        RewardTerm("lift", config.lift, lambda m: jnp.where(m.lifting, lift(m, config), 0.0)),
        RewardTerm("contact", config.contact, contact),
        RewardTerm("action_rate", config.action_rate, action_rate),
        RewardTerm("action_acceleration", config.action_acceleration, action_acceleration),
    )
    optional = (
        RewardTerm("way_left", config.way_left, lambda m: m.nearer),
        RewardTerm("posture", config.posture, lambda m: jnp.where(m.lifting, 0.0, m.homing)),
        RewardTerm("held", config.held, lambda m: held(m, config)),
        RewardTerm("force", config.force, lambda m: jnp.where(m.lifting, mean_force(m), 0.0)),
        RewardTerm("over_budget", config.over_budget, over_budget),
        RewardTerm("spent", config.spent, lambda m: jnp.where(m.lifting, spent(m), 0.0)),
        RewardTerm("hard", config.hard, lambda m: hard(m, config)),
    )
    return (*published, *(term for term in optional if term.weight))


def reach(moment: Moment, config: RewardConfig) -> Float[Array, "*b"]:
    """mean_f exp(−‖v_f − GVF_f‖_w / (s(‖GVF_f‖_w + ε))): the pads move as the field says."""
    error = twist_norm(moment.pad_twist - moment.guidance, config.turn_weight)
    asked = twist_norm(moment.guidance, config.turn_weight)
    scale = config.reach_scale * (asked + config.reach_floor)
    return jnp.mean(jnp.exp(-error / scale), axis=-1)


def lift(moment: Moment, config: RewardConfig) -> Float[Array, "*b"]:
    """exp(−((v_z − v*)/σ)²)·exp(−(|v_xy|/σ)²): the palm rises at the scripted speed, straight.

    v* is `lift_speed`, constant as published, or else the scripted lift's own speed at this time: 0
    once it has ended, so that the reward never asks for more height than the script.
    """
    velocity = moment.palm_velocity
    wanted = moment.lift_speed if config.lift_speed is None else config.lift_speed
    up = (velocity[..., 2] - wanted) / config.lift_scale
    sideways = jnp.sum(velocity[..., :2] ** 2, -1) / config.lift_scale**2
    return jnp.exp(-(up**2) - sideways)


def contact(moment: Moment) -> Float[Array, "*b"]:
    """The number of fingertips that touch the object."""
    return jnp.sum(moment.truth.tip_found, axis=-1).astype(jnp.float32)


def action_rate(moment: Moment) -> Float[Array, "*b"]:
    """|a_t − a_{t−1}|²."""
    return jnp.sum((moment.action - moment.last_action) ** 2, -1)


def action_acceleration(moment: Moment) -> Float[Array, "*b"]:
    """|a_t − 2a_{t−1} + a_{t−2}|²."""
    second = moment.action - 2.0 * moment.last_action + moment.before_last
    return jnp.sum(second**2, -1)


def held(moment: Moment, config: RewardConfig) -> Float[Array, "*b"]:
    """exp(−(s/σ)²), s the displacement of the object in the palm since lift onset, 0 before.

    It is paid in the lift and in the time before it. In the lift alone, to lift hastily would pay
    more than to lift surely; before it without an end, not to lift at all.
    """
    value = jnp.exp(-((moment.slip / config.held_scale) ** 2))
    return jnp.where(moment.lifting | moment.in_time, value, 0.0)


def finger_forces(moment: Moment) -> Float[Array, "*b f"]:
    """Contact force of each finger [N]."""
    return jnp.sqrt(jnp.sum(moment.truth.finger_force**2, -1) + 1e-12)


def mean_force(moment: Moment) -> Float[Array, "*b"]:
    """Contact force per finger [N]."""
    return jnp.mean(finger_forces(moment), axis=-1)


def over_budget(moment: Moment) -> Float[Array, "*b"]:
    """The mean force since lift onset beyond its budget, as far as `_MOST_EXCESS_N` [N].

    The mean over the time so far is what a budget is for: a short pull costs nothing if the grip is
    gentle before it.
    """
    return jnp.clip(moment.lift_force - moment.budget, 0.0, _MOST_EXCESS_N)


def spent(moment: Moment) -> Float[Array, "*b"]:
    """min(F, B)/B: which share of the budget the mean force per finger is, at most all of it."""
    return jnp.minimum(mean_force(moment) / moment.budget, 1.0)


def hard(moment: Moment, config: RewardConfig) -> Float[Array, "*b"]:
    """The largest force on a finger beyond `hard_from`, as far as `_MOST_EXCESS_N` [N]."""
    most = jnp.max(finger_forces(moment), axis=-1)
    return jnp.clip(most - config.hard_from, 0.0, _MOST_EXCESS_N)
