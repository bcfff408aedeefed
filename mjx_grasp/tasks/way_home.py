"""From each handoff back to home: the postures in which a task that reaches begins."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.scene import Scene
from mjx_grasp.tasks.starts import StartTable

RAISING = 0.4
"""Share of a way with a corner that leads up to it."""
ASTRAY = 2.0
"""How much longer a way counts for what a posture lies beside it: the nearer to the line, the
better, so that what pays most is to follow it."""


class WayHome(NamedTuple):
    """Postures on lines in joint space: row `k · n + i` is the i-th of start k.

    A line is straight, or has a corner where the palm is straight above the handoff, as far as the
    arm can lift it there. Each straight part has its postures evenly.
    """

    qpos: Float[Array, "kn nq"]
    ctrl: Float[Array, "kn nu"]
    measured: Measured
    """what the robot would measure there"""
    nearest: Int[Array, "k n"]
    """of each posture the one that is taken: itself, or the nearest that touches nothing"""
    blocked: int
    """postures that touch something they must not, of all k · n"""
    corner: Float[Array, "k joints"] | None
    """where the lines have one [rad]"""

    def row(self, start: Int[Array, " w"], way: Float[Array, " w"]) -> Int[Array, " w"]:
        """The posture nearest to a share of the way from a start's handoff (0) to home (1)."""
        postures = self.nearest.shape[1]
        i = jnp.round(way * (postures - 1)).astype(jnp.int32).clip(0, postures - 1)
        return start * postures + self.nearest[start, i]

    def left(
        self, q: Float[Array, "w joints"], start: Int[Array, " w"], moving: Int[np.ndarray, " m"]
    ) -> Float[Array, " w"]:
        """How long the way back to a start's handoff is from a configuration, over some joints.

        It goes along the line from the nearest point of it, which may be reached in a straight way.

        Args:
            q: Configurations [rad].
            start: Whose handoff.
            moving: Joints that count.
        """
        postures, goal = self.nearest.shape[1], start * self.nearest.shape[1]
        ends = [self.measured.q[goal], self.measured.q[goal + postures - 1]]
        if self.corner is not None:
            ends.insert(1, self.corner[start])
        ends = [end[:, moving] for end in ends]
        left, before = [], jnp.zeros(len(q))
        for near, far in pairwise(ends):
            away, length = _beside(q[:, moving], near, far)
            left.append(ASTRAY * away + before + length)
            before = before + jnp.linalg.norm(far - near, axis=-1)
        return jnp.min(jnp.stack(left), axis=0)


def _beside(
    q: Float[Array, "w m"], near: Float[Array, "w m"], far: Float[Array, "w m"]
) -> tuple[Float[Array, " w"], Float[Array, " w"]]:
    """How far a point is from a line between two others, and how far its foot from the nearer."""
    line = far - near
    square = jnp.maximum(jnp.sum(line**2, axis=-1), 1e-9)
    share = jnp.clip(jnp.sum((q - near) * line, axis=-1) / square, 0.0, 1.0)
    foot = share[:, None] * line
    return jnp.linalg.norm(q - near - foot, axis=-1), share * jnp.sqrt(square)


def build_way_home(scene: Scene, starts: StartTable, postures: int, raised: float = 0.0) -> WayHome:
    """Tabulates the postures, and which of them touch object, table or the robot itself.

    The handoff itself counts as free: the closing task begins there.

    Args:
        scene: The scene of the starts.
        starts: The handoffs.
        postures: How many there are of each, handoff and home included.
        raised: By how much the palm goes straight up first [m]; 0: straight home.
    """
    at, handoff = scene.addresses, np.asarray(starts.qpos, float)
    share = np.linspace(0.0, 1.0, postures)
    home, begin = np.array(scene.robot.home), handoff[:, at.robot_qpos]
    corner = _raised(scene, begin, raised) if raised else None
    if corner is None:
        q = _between(begin, home, share)
    else:
        first, then = share / RAISING, (share - RAISING) / (1.0 - RAISING)
        q = np.where(
            first[:, None] < 1.0, _between(begin, corner, first), _between(corner, home, then)
        )
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
        corner=None if corner is None else jnp.asarray(corner, jnp.float32),
    )


def _between(
    near: Float[np.ndarray, "k joints"],
    far: Float[np.ndarray, "*k joints"],
    share: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "k n joints"]:
    """On the straight lines from the first to the second."""
    return near[:, None] + share[:, None] * (far - near)[:, None]


def _raised(
    scene: Scene, q: Float[np.ndarray, "k joints"], height: float
) -> Float[np.ndarray, "k joints"]:
    """Where a lift straight up brings the robot, as far as its arm's limits let it."""
    body = robot_body(scene.robot)
    up = jax.jit(jax.vmap(lambda one: scripted_lift(body, one, height).q))
    return np.asarray(up(jnp.asarray(q, jnp.float32)), float)


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
