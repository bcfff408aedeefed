"""Whether the arm can raise the palm from a posture: no contact holds what is not lifted."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.linear import damped_least_squares, full_precision
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import PALM, Body
from mjx_grasp.robot.indices import robot_indices

_STEPS = 60
_DAMPING = 1e-4  # m², that of the scripted lift


class Lift(NamedTuple):
    """Where a scripted lift brings the palm."""

    rise: Float[Array, ""]
    """of the palm's origin, along the world's z [m]"""
    error: Float[Array, ""]
    """from where the palm's origin should be to where it is [m]"""
    q: Float[Array, " joints"]
    """configuration at the end [rad]"""


@full_precision
def scripted_lift(body: Body, q: Float[Array | np.ndarray, " joints"], height: float) -> Lift:
    """Raises the palm straight up as the closing law does: kinematics alone, without contacts.

    Damped least squares over the arm joints that the policy moves, each kept at its limit when it
    gets there. Then the palm no longer rises, or slides and turns away: so it fails from postures
    that begin near a limit. One posture; many are a ``vmap``.

    Args:
        body: The robot.
        q: Configuration at the start [rad].
        height: That is asked for [m].
    """
    moving = robot_indices(body.robot).arm_policy
    lower, upper = body.lower[moving], body.upper[moving]
    up = jnp.asarray([0.0, 0.0, height / _STEPS, 0.0, 0.0, 0.0])
    frame = np.array([PALM])

    def step(
        q: Float[Array, " joints"], _: None
    ) -> tuple[Float[Array, " joints"], Float[Array, " 3"]]:
        motion = body.kinematics.motion(q)
        palm = motion.pos[PALM]
        linear = body.point_jacobians(motion, frame, palm[None])[0]
        angular = body.angular_jacobians(motion, frame)[0]
        jacobian = jnp.concatenate([linear, angular])[:, moving]
        turn = damped_least_squares(jacobian, up, jnp.ones(6), _DAMPING)
        return q.at[moving].set(jnp.clip(q[moving] + turn, lower, upper)), palm

    last, palms = jax.lax.scan(step, jnp.asarray(q), length=_STEPS)
    moved = body.palm.forward(last)[0][0] - palms[0]
    return Lift(moved[2], norm(moved - jnp.asarray([0.0, 0.0, height])), last)
