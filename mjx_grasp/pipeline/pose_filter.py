"""The object's pose and twist from a tracker's noisy readings.

An alpha-beta filter for position and one for rotation, with the gains of a steady Kalman filter
(Kalata's tracking index), for a noise that it estimates itself from how the readings jitter. Where
they do not, each reading is taken as it is. Where they do, one that is the same as the last tells
nothing: the tracker has lost the object for a moment, or the object rests if it is more than one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.pipeline.config import PoseFilterConfig

# Share of a reading in the estimate of the noise.
_FRESH = 0.1
# One reading counts at most as this times the present noise, and a little, so that a push is not
# taken for noise: in standard deviations, [m] and [rad].
_OUTLIER = 3.0
_LITTLE = np.array([1e-4, 1e-3])
# Noise below which there is none, [m] and [rad].
_NONE = 1e-8
# Readings off by more than so many standard deviations, and so much, are of an object that was put
# elsewhere: [-], and [m] and [rad].
_JUMP = 10.0
_FAR = np.array([0.01, 0.1])
# Ticks for which the same reading is none; then the object rests.
_LOST = 5
# Of the noise of the velocities that speeds must pass, so that an object at rest stays so.
_CLEAR = 4.0


class PoseEstimate(NamedTuple):
    """What is known of the object's motion; world frame, position before rotation."""

    p_wo: Float[Array, " 3"]
    """object origin [m]"""
    R_wo: Float[Array, "3 3"]
    """object rotation"""
    rates: Float[Array, "2 3"]
    """its velocities, noise and all; none after a jump [m/s, rad/s]"""
    variance: Float[Array, " 2"]
    """of the readings, per axis [m², rad²]"""
    twist: Float[Array, " 6"]
    """its velocities, zero where they do not stand out of the noise; in a jump those that it would
    take [m/s, rad/s]"""
    last_p: Float[Array, " 3"]
    """the last reading [m]"""
    last_R: Float[Array, "3 3"]
    last_step: Float[Array, "2 3"]
    """its difference to the one before [m, rad]"""
    repeats: Int[Array, ""]
    """ticks since then"""


def start_estimate(p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"]) -> PoseEstimate:
    """The first reading, of an object at rest.

    Args:
        p_wo: Tracked object origin, world [m].
        R_wo: Tracked object rotation.
    """
    still = jnp.zeros((2, 3))
    return PoseEstimate(
        p_wo, R_wo, still, jnp.zeros(2), jnp.zeros(6), p_wo, R_wo, still, jnp.int32(0)
    )


def estimated(
    before: PoseEstimate,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    dt: float,
    config: PoseFilterConfig,
) -> PoseEstimate:
    """One more reading.

    Args:
        before: From `start_estimate` or the last reading.
        p_wo: Tracked object origin, world [m].
        R_wo: Tracked object rotation.
        dt: Time since the last reading [s].
        config: How quickly objects change their velocity.
    """
    step = jnp.stack([p_wo - before.last_p, so3.log(R_wo @ before.last_R.T)])
    same = jnp.all(p_wo == before.last_p) & jnp.all(R_wo == before.last_R)
    repeats = jnp.where(same, before.repeats + 1, 0)
    lost = same & (repeats <= _LOST) & jnp.any(before.variance > _LITTLE**2)
    variance = _noise(before.variance, step - before.last_step)
    variance = jnp.where(lost, before.variance, variance)
    # r: what one reading leaves of an error; alpha = 1 - r², beta = 2 (1 - r)².
    wanted = jnp.array([config.acceleration, config.turning]) * dt**2
    index = wanted / jnp.sqrt(variance + _NONE**2)
    r = 4.0 / (4.0 + index + jnp.sqrt(index * (8.0 + index)))
    alpha, beta = 1.0 - r**2, jnp.minimum(2.0 * (1.0 - r) ** 2, 1.0)

    ahead_p = before.p_wo + before.rates[0] * dt
    ahead_R = so3.exp(before.rates[1] * dt) @ before.R_wo
    p_wo, R_wo = jnp.where(lost, ahead_p, p_wo), jnp.where(lost, ahead_R, R_wo)
    off = jnp.stack([p_wo - ahead_p, so3.log(R_wo @ ahead_R.T)])
    jumps = norm(off) > _JUMP * jnp.sqrt(variance) + _FAR
    rates = before.rates + beta[:, None] / dt * off
    rates = jnp.where(jumps[:, None], 0.0, rates)
    kept = jnp.where(jumps, 0.0, r**2)
    shaken = 2.0 * beta**2 / (alpha * (4.0 - 2.0 * alpha - beta)) * variance / dt**2
    moves = norm(rates) > _CLEAR * jnp.sqrt(shaken)
    twist = jnp.where(moves[:, None], rates, 0.0)
    return PoseEstimate(
        p_wo=p_wo - kept[0] * off[0],
        R_wo=so3.exp(-kept[1] * off[1]) @ R_wo,
        rates=rates,
        variance=variance,
        twist=jnp.where(jumps[:, None], off / dt, twist).reshape(6),
        last_p=jnp.where(lost, before.last_p, p_wo),
        last_R=jnp.where(lost, before.last_R, R_wo),
        last_step=jnp.where(lost, before.last_step, step),
        repeats=repeats,
    )


def _noise(variance: Float[Array, " 2"], change: Float[Array, "2 3"]) -> Float[Array, " 2"]:
    """The variance of readings after one more, from the change of their differences."""
    # Of three axes, each a sum of one, minus two and one times independent noise.
    found = jnp.sum(change**2, axis=-1) / 18.0
    most = _OUTLIER**2 * variance + _LITTLE**2
    return variance + _FRESH * (jnp.minimum(found, most) - variance)
