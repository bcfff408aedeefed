"""An engine that reports what a test tells it to, so that the task's logic is tested alone."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_grasp.sim.physics import Readings


class ScriptedState(NamedTuple):
    tick: jax.Array  # [w] rows of the script that are done
    qpos: jax.Array
    ctrl: jax.Array


class ScriptedPhysics:
    """Reports `script` [t, w, ...] tick by tick; a reset world starts it again."""

    def __init__(self, scene, script, substeps=5):
        self.scene, self.substeps = scene, substeps
        self.script = jax.tree.map(jnp.asarray, script)

    def init(self, qpos, ctrl):
        return ScriptedState(jnp.zeros(len(qpos), jnp.int32), qpos, ctrl)

    def reset(self, state, mask, qpos, ctrl):
        return ScriptedState(
            jnp.where(mask, 0, state.tick),
            jnp.where(mask[:, None], qpos, state.qpos),
            jnp.where(mask[:, None], ctrl, state.ctrl),
        )

    def step(self, state, params, ctrl):
        worlds = jnp.arange(len(state.tick))
        last = self.script.q.shape[0] - 1
        readings = jax.tree.map(lambda x: x[jnp.minimum(state.tick, last), worlds], self.script)
        return ScriptedState(state.tick + 1, state.qpos, ctrl), readings

    def pack(self, state):
        return state._asdict()

    def unpack(self, packed):
        return ScriptedState(**packed)


def still(starts, rows, ticks):
    """A script [t, w, ...] of worlds in which nothing ever moves; numpy, to be changed."""

    def repeat(x):
        return np.repeat(np.asarray(x)[None, np.asarray(rows)], ticks, axis=0).copy()

    return Readings(*(repeat(x) for x in starts.readings))


def draw_of(rows, offset=0.0):
    """A draw of these rows without noise."""
    from mjx_grasp.tasks.starts import StartDraw

    n = len(rows)
    return StartDraw(
        row=jnp.asarray(rows, jnp.int32),
        offset=jnp.full((n, 2), offset),
        rotation=jnp.zeros((n, 3)),
        friction=jnp.full(n, 0.8),
        mass_scale=jnp.ones(n),
    )
