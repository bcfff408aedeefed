"""Whether a hand can hold an object at its contacts at all: what they ask for, what motors press.

Contacts whose normals do not oppose each other, or that are far beside the centre of mass, may ask
for more force than any policy has. What closes on them drops the object, whatever it has learned.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.signed_distance import Shape, signed_distance
from mjx_grasp.geometry.vectors import dot, unit
from mjx_grasp.grasp.levered import across_thin_wall
from mjx_grasp.grasp.wrench_margin import ContactConfig, Load, holding_force
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.posture.touch import pressing_force

_BEFORE_M, _BEYOND_M, _PLACES = -0.010, 0.025, 8  # of a target, where a finger may meet something
_BESIDE_M = 0.003  # that it meets with most of its pad


def pull(around: Surroundings, weight: Float[Array, ""] | float) -> Load:
    """A weight [N] at the object's centre of mass, world."""
    com = jnp.zeros(3) if around.com is None else around.com
    return Load(jnp.array([0.0, 0.0, -1.0]) * weight, around.p_wo + around.R_wo @ com)


def opposing(
    friction: float, contacts: Float[Array, "*n 3 3"], normals: Float[Array, "*n 3 3"]
) -> Bool[Array, "*n"]:
    """Whether thumb and wraps press against each other, and not past.

    The line from the thumb to the middle of the wraps is in the friction cones of both: some force
    holds against a pull from any side then. Or they face each other across a wall so thin that they
    lie on it, one beside the other: what they can hold there is for `can_hold` to say. That asks
    about the weight alone, and costs far more.

    Args:
        friction: Of the contacts [-].
        contacts: Thumb, first and second wrap [m].
        normals: Outward unit normals of the surface there [-].
    """
    least = np.cos(np.arctan(friction))
    line = unit(0.5 * (contacts[..., 1, :] + contacts[..., 2, :]) - contacts[..., 0, :])
    thumb, wraps = normals[..., 0, :], unit(normals[..., 1, :] + normals[..., 2, :])
    straight = (dot(line, -thumb) >= least) & (dot(line, wraps) >= least)
    facing = dot(unit(wraps - thumb), wraps) >= least
    return straight | (facing & across_thin_wall(contacts))


def met(
    shape: Shape, contacts: Float[Array, "*n 3 3"], normals: Float[Array, "*#n 3 3"]
) -> Bool[Array, "*n"]:
    """Whether both wraps meet the object when they close along their normals.

    Their targets are beside the contacts of a candidate, by a fixed distance: past the rim of a
    wall, or the end of a handle, one may find nothing there.

    Args:
        shape: Of the object.
        contacts: Thumb, first and second wrap, object frame [m].
        normals: Outward unit normals of the surface there, object frame [-].
    """
    depth = jnp.linspace(_BEFORE_M, _BEYOND_M, _PLACES)[:, None]
    path = contacts[..., 1:, None, :] - depth * normals[..., 1:, None, :]
    nearest = jnp.min(signed_distance(shape, path), axis=-1)
    return jnp.all(nearest <= _BESIDE_M, axis=-1)


def can_hold(
    body: Body,
    friction: float,
    closed: Float[Array, " joints"],
    contacts: Float[Array, "3 3"],
    normals: Float[Array, "3 3"],
    around: Surroundings,
) -> Bool[Array, ""]:
    """Whether the thumb's motors press as hard as contacts ask for to hold the object.

    Of an object of unknown weight: whether any force holds it. One posture; many are a ``vmap``.

    Args:
        body: The robot.
        friction: Of the contacts; with infinite friction any hold [-].
        closed: Configuration with the fingers on their contacts, as from `touching` [rad].
        contacts: Thumb, first and second wrap, world [m].
        normals: Outward unit normals of the surface there, world [-].
        around: The object.
    """
    if np.isinf(friction):
        return jnp.asarray(True)
    share = holding_force(contacts, -normals, pull(around, 1.0), ContactConfig(friction=friction))
    return can_press(body, share, closed, normals, around)


def can_press(
    body: Body,
    share: Float[Array, ""],
    closed: Float[Array, " joints"],
    normals: Float[Array, "3 3"],
    around: Surroundings,
) -> Bool[Array, ""]:
    """The same of contacts that ask for so much force.

    Args:
        body: The robot.
        share: Force that they ask for, by the object's weight; +inf where none is enough [-].
        closed: Configuration with the fingers on their contacts, as from `touching` [rad].
        normals: Outward unit normals of the surface at thumb, first and second wrap, world [-].
        around: The object.
    """
    weight = jnp.zeros(()) if around.weight is None else around.weight
    most = pressing_force(body, closed, -normals)[0]
    return jnp.isfinite(share) & (jnp.where(weight > 0, share * weight, 0.0) <= most)
