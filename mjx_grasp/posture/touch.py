"""Whether the fingers reach their contacts from a posture: one that stays short of it grips air."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.linear import damped_least_squares, full_precision
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import FINGERS, Body
from mjx_grasp.robot.indices import robot_indices

_ITERATIONS = 25
_LONGEST_STEP = 0.3  # rad
_DAMPING = 1e-5  # m²
_PADS = np.arange(FINGERS, 2 * FINGERS)  # among the body's frames


@full_precision
def touch_errors(
    body: Body, q: Float[Array | np.ndarray, " joints"], contacts: Float[Array | np.ndarray, "f 3"]
) -> Float[Array, " f"]:
    """How far each pad stays from its contact when its finger does what it can, palm at rest [m].

    Gauss–Newton over the joints that the policy moves, those at a limit held there. Collisions do
    not count. One posture; many are a ``vmap``.

    Args:
        body: The robot.
        q: Configuration at the start [rad].
        contacts: Where thumb, first and second wrap are to touch, world [m].
    """
    joints = robot_indices(body.robot).per_finger
    lower, upper = body.lower[joints], body.upper[joints]

    def missing(q: Float[Array, " joints"]) -> tuple[Float[Array, "f 3"], Float[Array, "f 3 m"]]:
        motion = body.kinematics.motion(q)
        pads = motion.pos[_PADS]
        jacobian = body.point_jacobians(motion, _PADS, pads)
        own = jnp.take_along_axis(jacobian, jnp.asarray(joints)[:, None, :], axis=2)
        return jnp.asarray(contacts) - pads, own

    def step(q: Float[Array, " joints"], _: None) -> tuple[Float[Array, " joints"], None]:
        error, jacobian = missing(q)
        now, push = q[joints], jnp.sum(jacobian * error[:, :, None], axis=1)
        held = ((now <= lower) & (push < 0)) | ((now >= upper) & (push > 0))
        free = jnp.where(held[:, None, :], 0.0, jacobian)
        turn = damped_least_squares(free, error, jnp.ones(3), _DAMPING)
        turn = jnp.clip(turn, -_LONGEST_STEP, _LONGEST_STEP)
        return q.at[joints].set(jnp.clip(now + turn, lower, upper)), None

    closed, _ = jax.lax.scan(step, jnp.asarray(q), length=_ITERATIONS)
    return norm(missing(closed)[0])
