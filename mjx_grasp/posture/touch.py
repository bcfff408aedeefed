"""Whether the fingers reach their contacts from a posture: one that stays short of it grips air."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.linear import damped_least_squares, full_precision
from mjx_grasp.geometry.vectors import dot, norm
from mjx_grasp.posture.body import FINGERS, Body
from mjx_grasp.robot.indices import robot_indices

_ITERATIONS = 25
_LONGEST_STEP = 0.3  # rad
_DAMPING = 1e-5  # m²
_LEAST_LEVER = 1e-6  # m
_PADS = np.arange(FINGERS, 2 * FINGERS)  # among the body's frames


@full_precision
def touch_errors(
    body: Body, q: Float[Array | np.ndarray, " joints"], contacts: Float[Array | np.ndarray, "f 3"]
) -> Float[Array, " f"]:
    """How far each pad stays from its contact in `touching`, which has the arguments [m]."""
    return touching(body, q, contacts).error


class Touching(NamedTuple):
    """Fingers that have closed as far as they can."""

    error: Float[Array, " f"]
    """of each pad from its contact [m]"""
    q: Float[Array, " joints"]
    """[rad]"""


@full_precision
def touching(
    body: Body, q: Float[Array | np.ndarray, " joints"], contacts: Float[Array | np.ndarray, "f 3"]
) -> Touching:
    """Closes the fingers on their contacts as far as each can, palm at rest.

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
    return Touching(norm(missing(closed)[0]), closed)


@full_precision
def pad_angles(
    body: Body, q: Float[Array | np.ndarray, " joints"], normals: Float[Array, "f 3"]
) -> Float[Array, " f"]:
    """How far each pad is turned from facing its contact [rad].

    Args:
        body: The robot.
        q: Configuration with the fingers on their contacts, as from `touching` [rad].
        normals: Outward unit normals of the surface there, world [-].
    """
    outward = -body.kinematics.motion(jnp.asarray(q)).mat[_PADS, :, 0]
    return jnp.arccos(jnp.clip(dot(outward, normals), -1.0, 1.0))


@full_precision
def pressing_force(
    body: Body, q: Float[Array | np.ndarray, " joints"], inward: Float[Array, "f 3"]
) -> Float[Array, " f"]:
    """The most that the motors of each finger can press along a direction, palm at rest [N].

    By the motor that comes to its limit first; +inf where none has one.

    Args:
        body: The robot.
        q: Configuration [rad].
        inward: Unit directions of thumb, first and second wrap, world [-].
    """
    motion = body.kinematics.motion(jnp.asarray(q))
    jacobian = body.point_jacobians(motion, _PADS, motion.pos[_PADS])
    torque = jnp.abs(jnp.einsum("fcj,fc->fj", jacobian, inward))[:, ~body.arm]
    limit = jnp.asarray(body.torque_limit)[~body.arm]
    return jnp.min(limit / jnp.maximum(torque, _LEAST_LEVER), axis=1)
