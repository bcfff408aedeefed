"""Where the palm comes from: straight from above, or level from the side."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.errors import InputError
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.library import Library

Approach = Literal["any", "above", "side"]


def deviation(body: Body, q: Float[Array, " joints"], approach: Approach) -> Float[Array, ""]:
    """Angle between the axis out of the palm and where it should point, 0 for ``any`` [rad].

    Args:
        body: The robot.
        q: Posture [rad].
        approach: ``above``: straight down. ``side``: anywhere level.
    """
    if approach == "any":
        return jnp.float32(0.0)
    _, mat = body.palm.forward(q)
    down = -(mat[0, 2] @ body.approach_axis)
    tilt = jnp.arccos(jnp.clip(down, -1.0, 1.0))
    return tilt if approach == "above" else jnp.abs(0.5 * jnp.pi - tilt)


def approaching(body: Body, library: Library, approach: Approach, angle: float) -> Library:
    """The entries of a library whose palm comes from there.

    Args:
        body: The robot.
        library: Of this robot.
        approach: From where.
        angle: Give or take [rad].

    Raises:
        InputError: There is none.
    """
    if approach == "any":
        return library
    off = jax.jit(jax.vmap(lambda q: deviation(body, q, approach)))(library.q)
    kept = np.flatnonzero(np.asarray(off) <= angle)
    if not len(kept):
        raise InputError("plan.approach", approach, "one from which the robot reaches the table")
    return jax.tree.map(lambda leaf: leaf[kept], library)
