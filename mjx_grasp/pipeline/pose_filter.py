"""The object's pose and twist from a tracker's readings, however noisy and however rare.

A Kalman filter of constant velocity for position and one for rotation. It estimates the noise
itself: noise is what the next readings take back, and a push is not. Where there is none, each
reading is taken as it is. A noisy tracker never says the same twice, nor does a slow one of what
moves; where a reading is the same as the last, there is none, and the object goes on as it did.
That is not believed for much longer than the tracker's usual time between readings: then the object
rests.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.linear import full_precision
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.pipeline.config import PoseFilterConfig

# All pairs are of position and rotation, [m] and [rad].
# Noise below which there is none, and the most: a pose that flips between two places must not be
# averaged.
_LITTLE = np.array([1e-4, 1e-3])
_MOST = np.array([2e-2, 1.5e-1])
# Share of a reading in the estimate of the noise. One counts at most as this many times the present
# noise, in standard deviations, and a little.
_FRESH = 0.05
_OUTLIER = 3.0
# A reading further off than so many standard deviations, and so much for each tick of the usual
# time, is of an object that was put elsewhere.
_JUMP = 10.0
_FAR = np.array([1e-2, 1e-1])
# For how long the same reading is none: at least so many ticks, or usual times between readings. A
# tracker is slow whose usual time is longer than so many ticks; more than so many are not usual.
_LOST = 5
_PATIENT = 2.0
_SLOW = 1.5
_LONG = 30
_LEARNS = 0.2
# Standard deviations of its own that a speed has to pass.
_CLEAR = 2.5


class PoseEstimate(NamedTuple):
    """What is known of the object's motion; world frame, position before rotation."""

    p_wo: Float[Array, " 3"]
    """object origin [m]"""
    R_wo: Float[Array, "3 3"]
    """object rotation"""
    rates: Float[Array, "2 3"]
    """its velocities [m/s, rad/s]"""
    twist: Float[Array, " 6"]
    """the same, zero where they do not stand out of their uncertainty; in a jump those that it
    would take [m/s, rad/s]"""
    covariance: Float[Array, "3 2"]
    """per axis: of the pose, of pose and velocity, and of the velocity [m², m²/s, m²/s² and rad]"""
    noise: Float[Array, " 2"]
    """variance of the readings, per axis [m², rad²]"""
    last_p: Float[Array, " 3"]
    """the last reading [m]"""
    last_R: Float[Array, "3 3"]
    last_step: Float[Array, "2 3"]
    """its difference to the one before [m, rad]"""
    last_bend: Float[Array, "2 3"]
    """and by how much that was not what the difference before promised [m, rad]"""
    gaps: Float[Array, " 3"]
    """ticks from each of the last readings to the next, the latest first [-]"""
    repeats: Int[Array, ""]
    """ticks since the last was new"""
    usual: Float[Array, ""]
    """usual number of ticks from one to the next [-]"""


def start_estimate(p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"]) -> PoseEstimate:
    """The first reading, of an object at rest.

    Args:
        p_wo: Tracked object origin, world [m].
        R_wo: Tracked object rotation.
    """
    none = jnp.zeros((2, 3))
    return PoseEstimate(
        p_wo=p_wo,
        R_wo=R_wo,
        rates=none,
        twist=jnp.zeros(6),
        covariance=jnp.zeros((3, 2)),
        noise=jnp.zeros(2),
        last_p=p_wo,
        last_R=R_wo,
        last_step=none,
        last_bend=none,
        gaps=jnp.ones(3),
        repeats=jnp.int32(0),
        usual=jnp.float32(1.0),
    )


@full_precision
def estimated(
    before: PoseEstimate,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    dt: float,
    config: PoseFilterConfig,
) -> PoseEstimate:
    """One tick later.

    Args:
        before: From `start_estimate` or the last tick.
        p_wo: Tracked object origin, world, the last one where there is no new one [m].
        R_wo: Tracked object rotation; what is not finite is no reading.
        dt: Time since the last tick [s].
        config: How quickly objects change their velocity.
    """
    found = jnp.all(jnp.isfinite(p_wo)) & jnp.all(jnp.isfinite(R_wo))
    p_wo, R_wo = jnp.where(found, p_wo, before.last_p), jnp.where(found, R_wo, before.last_R)
    same = jnp.all(p_wo == before.last_p) & jnp.all(R_wo == before.last_R)
    gap = before.repeats + 1
    patience = jnp.maximum(_PATIENT * before.usual, _LOST)
    rare = jnp.any(before.noise > _LITTLE**2) | (before.usual > _SLOW)
    lost = same & (gap <= patience) & rare

    step = jnp.stack([p_wo - before.last_p, so3.log(so3.product(R_wo, before.last_R.T))])
    gaps = jnp.concatenate([jnp.atleast_1d(gap).astype(jnp.float32), before.gaps[:2]])
    bend = step - gaps[0] / gaps[1] * before.last_step
    noise = jnp.where(same, before.noise, _noise(before.noise, bend, before.last_bend, gaps))

    # As it was expected to go on, with white acceleration.
    ahead_p = before.p_wo + before.rates[0] * dt
    ahead_R = so3.product(so3.exp(before.rates[1] * dt), before.R_wo)
    pose, both, rate = before.covariance
    density = np.array([config.agility, config.turning])
    pose = pose + (2.0 * both + (rate + density * dt / 3.0) * dt) * dt
    both = both + (rate + density * dt / 2.0) * dt
    rate = rate + density * dt

    off = jnp.stack([p_wo - ahead_p, so3.log(so3.product(R_wo, ahead_R.T))])
    spread = jnp.sqrt(pose + noise)
    jumps = ~lost & (norm(off) > _JUMP * spread + _FAR * before.usual)
    gains = jnp.where(lost, 0.0, jnp.stack([pose, both]) / (pose + noise))
    rates = before.rates + gains[1, :, None] * off
    clear = norm(rates) > _CLEAR * jnp.sqrt(rate - gains[1] * both)
    twist = jnp.where(clear[:, None], rates, 0.0)
    nearer = jnp.where(jumps, 1.0, gains[0])[:, None] * off
    return PoseEstimate(
        p_wo=ahead_p + nearer[0],
        R_wo=so3.product(so3.exp(nearer[1]), ahead_R),
        rates=jnp.where(jumps[:, None], 0.0, rates),
        twist=jnp.where(jumps[:, None], off / dt, twist).reshape(6),
        covariance=jnp.where(
            jumps,
            jnp.stack([noise, 0.0 * both, 0.0 * rate]),
            jnp.stack([pose * (1.0 - gains[0]), both * (1.0 - gains[0]), rate - gains[1] * both]),
        ),
        noise=noise,
        last_p=p_wo,
        last_R=R_wo,
        last_step=jnp.where(same, before.last_step, step),
        last_bend=jnp.where(same, before.last_bend, bend),
        gaps=jnp.where(same, before.gaps, gaps),
        repeats=jnp.where(same, gap, 0),
        usual=jnp.where(same | (gap > _LONG), before.usual, _usual(before.usual, gap)),
    )


def _noise(
    noise: Float[Array, " 2"],
    bend: Float[Array, "2 3"],
    last: Float[Array, "2 3"],
    gaps: Float[Array, " 3"],
) -> Float[Array, " 2"]:
    """The variance of readings after one more, from two bends in turn."""
    # With z the readings and r the ratios of gaps, a bend is z₀ - (1 + r₀) z₁ + r₀ z₂, the last one
    # z₁ - (1 + r₁) z₂ + r₁ z₃: of independent noise they share two readings.
    now, before = gaps[0] / gaps[1], gaps[1] / gaps[2]
    shared = 1.0 + now + now * (1.0 + before)
    found = -jnp.sum(bend * last, axis=-1) / (3.0 * shared)
    most = _OUTLIER**2 * noise + _LITTLE**2
    return jnp.clip(noise + _FRESH * (jnp.clip(found, -most, most) - noise), 0.0, _MOST**2)


def _usual(usual: Float[Array, ""], gap: Int[Array, ""]) -> Float[Array, ""]:
    return usual + _LEARNS * (gap - usual)
