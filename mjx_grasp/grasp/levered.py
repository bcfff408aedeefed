"""Grasps of thin walls beside the centre of mass: thumb and wraps at different heights (§2).

What is gripped by its rim hangs on it and turns in fingers that oppose each other, however hard
they press: across a thin wall they have no lever. With the thumb some way along the wall their
forces make a couple, against that of the weight.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.vectors import norm, unit
from mjx_grasp.grasp.candidates import Candidates

THIN_M = 0.020
"""Walls up to this thick count as thin: across thicker ones opposing fingers have a lever [m]."""
LEVER_M = 0.015
"""How far along the wall the thumb moves [m]."""
_LEAST_ARM_M = 0.020  # of the weight: with less, fingertips bear the moment by themselves
_NEAR = 0.3  # share of the lever: so near to where the thumb is to be there has to be a surface
_ALIKE = 0.8  # least cosine between the normals there and where the thumb was


def across_thin_wall(contacts: Float[Array, "*n f 3"]) -> Bool[Array, "*n"]:
    """Whether the thumb and the middle of the others are so near that only a thin wall is between.

    Args:
        contacts: The thumb's first [m].
    """
    return norm(jnp.mean(contacts[..., 1:, :], axis=-2) - contacts[..., 0, :]) <= THIN_M


def levered(
    bases: Candidates, surface: Candidates, com: Float[Array, " 3"], ups: Float[Array, "u 3"]
) -> Candidates:
    """Candidates whose thumb has moved along the wall; for each base one of each direction.

    With g the grasp axis, r from the wraps to the centre of mass, and z upwards, the thumb moves
    along ``g × (r × z)``: upwards where it is on the side of the centre of mass, as inside a bowl,
    downwards on the other. Where there is no thin wall, not enough of it or no moment to speak of,
    they are invalid. Jittable.

    Args:
        bases: What is to be gripped otherwise.
        surface: All candidates of the object, for their thumbs and the normals there.
        com: Centre of mass, object frame [m].
        ups: Unit directions that may be upwards, object frame.
    """
    r, g = com - bases.centre, bases.axis
    way = jnp.cross(g[:, None], jnp.cross(r[:, None], ups))
    wanted = bases.thumb[:, None] + LEVER_M * unit(way)
    alike = surface.valid & (bases.normal @ surface.normal.T >= _ALIKE)
    away = jnp.where(alike[:, None], norm(wanted[:, :, None] - surface.thumb), jnp.inf)
    thumb = jnp.argmin(away, axis=-1)
    there = jnp.min(away, axis=-1) <= _NEAR * LEVER_M
    thin = (bases.valid & (bases.width <= THIN_M))[:, None]
    valid = (thin & there & (norm(way) >= _LEAST_ARM_M)).reshape(-1)
    every = jnp.repeat(jnp.arange(len(bases.score)), len(ups))
    return Candidates(
        thumb=surface.thumb[thumb.reshape(-1)],
        normal=surface.normal[thumb.reshape(-1)],
        wrap=bases.wrap[every],
        wrap_normal=bases.wrap_normal[every],
        axis=bases.axis[every],
        width=bases.width[every],
        score=jnp.where(valid, bases.score[every], 0.0),
        valid=valid,
    )
