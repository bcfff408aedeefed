"""Which way out of a grasp the tips have free."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.posture.surroundings import Surroundings, to_object

_PLACES = 24
"""Of each tip on a way: a few millimetres apart, for walls are thin."""


def freer(
    way: Float[Array, " 3"],
    tips: Float[Array, "f 3"],
    length: float,
    around: Surroundings,
    enough: float,
) -> Float[Array, " 3"]:
    """A way out, or straight up where the tips keep farther from the object on that one.

    Sideways the tips leave what has two flat sides, but not a wall that turns round, as a bowl's
    does: those inside would go through it. Tips and object are looked at, nothing else.

    Args:
        way: Unit direction, world.
        tips: Where they are now [m].
        length: Of the way [m].
        around: The object.
        enough: Distance from the object that no greater one is better than [m].

    Returns:
        One of the two directions; of two that are as free the first.
    """
    ways = jnp.stack([way, jnp.array([0.0, 0.0, 1.0])])
    share = jnp.arange(1, _PLACES + 1)[:, None, None] / _PLACES
    path = tips + length * share * ways[:, None, None]
    away = jnp.min(signed_distance(around.shape, to_object(around, path)), axis=(1, 2))
    return ways[jnp.argmax(jnp.minimum(away, enough))]
