"""A tracker of object poses as it is in practice: late, noisy, with readings missing."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.evaluation.grasps.scenario import LONGEST_DELAY_S, TrackerConfig
from mjx_grasp.geometry import so3

# Ticks after which any tracker has a reading.
_LONG_AGO = 10**6


class Faults(NamedTuple):
    """A `TrackerConfig` as numbers of a compiled function, one for all worlds or one each."""

    position: Float[Array, "*w"]
    """[m]"""
    rotation: Float[Array, "*w"]
    """[rad]"""
    age: Int[Array, "*w"]
    """of a reading in ticks"""
    dropout: Float[Array, "*w"]
    period: Int[Array, "*w"]
    """of readings in ticks"""

    @classmethod
    def of(cls, config: TrackerConfig, dt: float) -> Faults:
        """With ticks of ``dt`` [s]."""
        age, period = jnp.int32(round(config.delay / dt)), jnp.int32(round(config.period / dt))
        position, rotation = jnp.float32(config.position), jnp.float32(config.rotation)
        return cls(position, rotation, age, jnp.float32(config.dropout), period)


class Track(NamedTuple):
    """What the tracker remembers; world frame, worlds in front."""

    late_pos: Float[Array, "w age 3"]
    """true object origins, the latest first [m]"""
    late_mat: Float[Array, "w age 3 3"]
    p_wo: Float[Array, "w 3"]
    """the last reading that arrived [m]"""
    R_wo: Float[Array, "w 3 3"]
    since: Int[Array, " w"]
    """ticks since it was due"""


def start_track(p_wo: Float[Array, "w 3"], R_wo: Float[Array, "w 3 3"], dt: float) -> Track:
    """A tracker that has long looked at an object at rest.

    Args:
        p_wo: True object origins [m].
        R_wo: True rotations.
        dt: Time between readings [s].
    """
    ages = round(LONGEST_DELAY_S / dt) + 1
    pos, mat = (jnp.repeat(x[:, None], ages, axis=1) for x in (p_wo, R_wo))
    return Track(pos, mat, p_wo, R_wo, jnp.full(len(p_wo), _LONG_AGO, jnp.int32))


def track(
    before: Track,
    p_wo: Float[Array, "w 3"],
    R_wo: Float[Array, "w 3 3"],
    keys: Array,
    faults: Faults,
) -> Track:
    """What it says of each world a tick later; exactly the truth if there are no faults.

    Args:
        before: From `start_track` or the last reading.
        p_wo: True object origins now [m].
        R_wo: True rotations now.
        keys: Of each world, for the noise and for what is lost.
        faults: The tracker's.
    """
    late_pos = jnp.concatenate([p_wo[:, None], before.late_pos[:, :-1]], axis=1)
    late_mat = jnp.concatenate([R_wo[:, None], before.late_mat[:, :-1]], axis=1)
    moved, turned, lost = jnp.moveaxis(jax.vmap(partial(jax.random.split, num=3))(keys), 1, 0)
    noise = jax.vmap(partial(jax.random.normal, shape=(3,)))
    worlds = jnp.arange(len(p_wo))
    faults = jax.tree.map(lambda x: jnp.broadcast_to(x, worlds.shape), faults)
    off = faults.position[:, None] * noise(moved)
    p = late_pos[worlds, faults.age] + off
    off = faults.rotation[:, None] * noise(turned)
    R = late_mat[worlds, faults.age] @ jax.vmap(so3.exp)(off)
    since = before.since + 1
    due = since >= faults.period
    gone = ~due | jax.vmap(jax.random.bernoulli)(lost, faults.dropout)
    return Track(
        late_pos,
        late_mat,
        jnp.where(gone[:, None], before.p_wo, p),
        jnp.where(gone[:, None, None], before.R_wo, R),
        jnp.where(due, 0, since),
    )
