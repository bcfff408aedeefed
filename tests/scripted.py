"""An engine that reports what a test tells it to, so that the task's logic is tested alone."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Physics, Truth


class ScriptedState(NamedTuple):
    tick: jax.Array  # [w] rows of the script that are done
    qpos: jax.Array
    ctrl: jax.Array


class Script(NamedTuple):
    """What an engine is to report [t, w, ...]; numpy, to be changed."""

    measured: Measured
    truth: Truth


class ScriptedPhysics(Physics):
    """Reports a script tick by tick; a reset world starts it again."""

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
        last = len(self.script.measured.q) - 1
        now = jax.tree.map(lambda x: x[jnp.minimum(state.tick, last), worlds], self.script)
        return ScriptedState(state.tick + 1, state.qpos, ctrl), *now


def still(starts, rows, ticks):
    """A script of worlds in which nothing ever moves."""

    def repeat(x):
        return np.repeat(np.asarray(x)[None, np.asarray(rows)], ticks, axis=0).copy()

    return Script(*jax.tree.map(repeat, (starts.measured, starts.truth)))


def draw_of(rows, offset=0.0):
    """A draw of these rows without noise."""
    from mjx_grasp.tasks.robot_errors import RobotDraw
    from mjx_grasp.tasks.starts import StartDraw

    n = len(rows)
    return StartDraw(
        row=jnp.asarray(rows, jnp.int32),
        offset=jnp.full((n, 2), offset),
        rotation=jnp.zeros((n, 3)),
        friction=jnp.full(n, 0.8),
        mass_scale=jnp.ones(n),
        budget=jnp.full(n, 3.0),
        robot=RobotDraw(jnp.ones(n), jnp.zeros(n), jnp.zeros(n), jnp.zeros(n, jnp.int32)),
    )
