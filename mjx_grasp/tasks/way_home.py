"""From each handoff back to home: the postures in which a task that reaches begins."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.scene import Scene
from mjx_grasp.tasks.starts import StartTable


class WayHome(NamedTuple):
    """Postures on straight lines in joint space, evenly: row `k · n + i` is the i-th of start k."""

    qpos: Float[Array, "kn nq"]
    ctrl: Float[Array, "kn nu"]
    measured: Measured
    """what the robot would measure there"""
    nearest: Int[Array, "k n"]
    """of each posture the one that is taken: itself, or the nearest that touches nothing"""
    blocked: int
    """postures that touch something they must not, of all k · n"""

    def row(self, start: Int[Array, " w"], way: Float[Array, " w"]) -> Int[Array, " w"]:
        """The posture nearest to a share of the way from a start's handoff (0) to home (1)."""
        postures = self.nearest.shape[1]
        i = jnp.round(way * (postures - 1)).astype(jnp.int32).clip(0, postures - 1)
        return start * postures + self.nearest[start, i]


def build_way_home(scene: Scene, starts: StartTable, postures: int) -> WayHome:
    """Tabulates the postures, and which of them touch object, table or the robot itself.

    The handoff itself counts as free: the closing task begins there.

    Args:
        scene: The scene of the starts.
        starts: The handoffs.
        postures: How many there are of each, handoff and home included.
    """
    at, handoff = scene.addresses, np.asarray(starts.qpos, float)
    share = np.linspace(0.0, 1.0, postures)[:, None]
    home = np.array(scene.robot.home)
    q = (1.0 - share) * handoff[:, None, at.robot_qpos] + share * home
    qpos = np.repeat(handoff[:, None], postures, axis=1)
    qpos[:, :, at.robot_qpos] = q
    ctrl = np.repeat(np.asarray(starts.ctrl, float)[:, None], postures, axis=1)
    ctrl[:, :, at.robot_ctrl] = q
    flat = qpos.reshape(-1, qpos.shape[-1])
    free = _free(scene, qpos, np.asarray(starts.object_index))
    measured, _ = at_rest(scene, flat, starts.measured.external_torque.shape[1])
    return WayHome(
        qpos=jnp.asarray(flat, jnp.float32),
        ctrl=jnp.asarray(ctrl.reshape(-1, ctrl.shape[-1]), jnp.float32),
        measured=measured,
        nearest=jnp.asarray(nearest_free(free), jnp.int32),
        blocked=int((~free).sum()),
    )


def nearest_free(free: Bool[np.ndarray, "k n"]) -> Int[np.ndarray, "k n"]:
    """Of each posture the nearest free one of its row, of two the one nearer to the handoff."""
    i = np.arange(free.shape[1])
    away = np.abs(i[:, None] - i)
    return np.argmin(np.where(free[:, None], away, free.shape[1]), axis=-1)


def _free(
    scene: Scene, qpos: Float[np.ndarray, "k n nq"], object_index: Int[np.ndarray, " k"]
) -> Bool[np.ndarray, "k n"]:
    checker, at = CollisionChecker(scene), scene.addresses
    free = np.ones(qpos.shape[:2], bool)
    for k, row in enumerate(qpos):
        for i, state in enumerate(row[1:], start=1):
            pos, quat = state[at.object_qpos[:3]], state[at.object_qpos[3:]]
            reason = checker.reason(state[at.robot_qpos], pos, quat, int(object_index[k]))
            free[k, i] = reason is None
    return free
