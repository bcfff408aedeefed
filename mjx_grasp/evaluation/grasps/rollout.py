"""Closed-loop rollouts of the `Grasper` in native MuJoCo, all trials together.

The controller is given what a robot has: its measurements, a tracked object pose, touch flags. The
truth is the judge's alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Ways
from mjx_grasp.posture.library import Library
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import NativePhysics, NativeState, at_rest
from mjx_grasp.sim.physics import Truth, WorldParams, make_params
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import Progress, in_palm, initial_progress, update_progress

_SEGMENT = 10
"""Ticks between two looks for worlds that want new plans: the time that planning takes."""
_PLANS_AT_ONCE = 8
_HOLD_S = 1.0
"""Time at the top after which a trial has ended [s]."""


class GraspProblem(NamedTuple):
    """What is grasped in each trial; world frame."""

    object_index: Int[np.ndarray, " w"]
    """into the scene's objects"""
    p_wo: Float[np.ndarray, "w 3"]
    """object origin at the start [m]"""
    quat: Float[np.ndarray, "w 4"]
    """its rotation, w-x-y-z"""


class Trace(NamedTuple):
    """What is kept of every tick of each trial."""

    phase: Int[Array, "t w"]
    qpos: Float[Array, "t w nq"]
    rise: Float[Array, "t w"]
    """of the object origin since the start [m]"""
    tip_error: Float[Array, "t w 3"]
    """see `GraspTick.tip_error` [m]"""
    contacts: Float[Array, "t w 3 3"]
    """the three points that the hand goes for, world [m]"""
    touching: Bool[Array, "t w f"]
    """by the simulator"""
    observed: Bool[Array, "t w f"]
    """by the momentum observer, from the handoff on"""
    force: Float[Array, "t w f"]
    """on each finger, by the simulator [N]"""
    felt: Float[Array, "t w f"]
    """the same estimated from joint torques, from the handoff on [N]"""


class GraspEnd(NamedTuple):
    """How the trials ended."""

    state: GraspState
    progress: Progress
    replans: Int[np.ndarray, " w"]
    """times that new plans were made"""


class _Carry(NamedTuple):
    """All that goes from tick to tick."""

    physics: NativeState
    measured: Measured
    truth: Truth
    grasp: GraspState
    due: Bool[Array, " w"]
    reference: Float[Array, "w 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress


def grasp_all(
    grasper: Grasper,
    library: Library,
    physics: NativePhysics,
    known: Known,
    problem: GraspProblem,
    seed: int = 0,
    told: bool = True,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[GraspEnd, Trace]:
    """Grasps from home, until every trial has ended.

    Args:
        grasper: The controller.
        library: Where its planner starts.
        physics: Of the scene with all objects of the problem.
        known: Of each trial's object, stacked.
        problem: Objects and where they are.
        seed: Of the plans.
        told: Whether the fingertips tell what they touch; else the momentum observer alone does.
        progress: Told which share of the longest possible time is done.
    """
    scene, worlds = physics.scene, len(problem.object_index)
    at = scene.addresses
    home = np.asarray(grasper.reacher.body.home, np.float32)
    qpos = np.zeros((worlds, scene.model.nq), np.float32)
    qpos[:, at.robot_qpos] = home
    qpos[:, at.object_qpos] = np.concatenate([problem.p_wo, problem.quat], axis=1)
    params = make_params(jnp.asarray(problem.object_index), scene.config.friction[0])
    measured, truth = at_rest(scene, qpos, physics.substeps)
    order = np.argsort(at.robot_ctrl)
    ctrl = jnp.broadcast_to(jnp.asarray(home[order]), (worlds, len(home)))

    key = jax.random.key(seed)
    see = partial(_seen, told=told)
    nowhere = jnp.full((worlds, 3), jnp.inf)
    plans = _planned(
        grasper, library, known, see(truth), measured.q, nowhere, key, np.arange(worlds)
    )
    grasp = jax.jit(jax.vmap(grasper.start))(measured, known, see(truth), plans)
    carry = _Carry(
        physics.init(jnp.asarray(qpos), ctrl), measured, truth, grasp, jnp.zeros(worlds, bool),
        in_palm(measured, truth), initial_progress((worlds,)),
    )  # fmt: skip
    advance = jax.jit(
        partial(_segment, grasper, physics, order, told=told, base=problem.p_wo[:, 2])
    )
    adopt = jax.jit(jax.vmap(grasper.adopt))
    replans, parts = np.zeros(worlds, int), []
    longest = grasper.config.timeout_s + _HOLD_S + 2.0
    for number in range(round(longest / grasper.dt / _SEGMENT)):
        carry, part = advance(carry, params, known)
        parts.append(jax.tree.map(np.asarray, part))
        progress(number * _SEGMENT * grasper.dt / longest)
        if np.all(_ended(carry.grasp)):
            break
        due = np.flatnonzero(carry.due)
        if len(due):
            key = jax.random.fold_in(key, number)
            now, avoid = see(carry.truth), carry.grasp.avoid
            found = _planned(grasper, library, known, now, carry.measured.q, avoid, key, due)
            new, mask = _spread(found, carry.grasp.ways, due), np.isin(np.arange(worlds), due)
            carry = carry._replace(
                grasp=_where(mask, adopt(carry.grasp, new), carry.grasp), due=carry.due & ~mask
            )
            replans[due] += 1
    grasp, judged = jax.tree.map(np.asarray, (carry.grasp, carry.progress))
    trace = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return GraspEnd(grasp, judged, replans), trace


def _segment(
    grasper: Grasper,
    physics: NativePhysics,
    order: Int[np.ndarray, " n"],
    carry: _Carry,
    params: WorldParams,
    known: Known,
    *,
    told: bool,
    base: Float[np.ndarray, " w"],
) -> tuple[_Carry, Trace]:
    """Some ticks of all worlds."""
    success, closer = SuccessConfig(), grasper.closer

    def tick(carry: _Carry, _: None) -> tuple[_Carry, Trace]:
        before = carry.grasp.closing.closer.lifting
        grasp, done = jax.vmap(grasper.tick)(
            carry.grasp, carry.measured, known, _seen(carry.truth, told)
        )
        state, measured, truth = physics.step(carry.physics, params, done.target[:, order])
        here = in_palm(measured, truth)
        reference = jnp.where(before[:, None], carry.reference, here)
        lifting = grasp.closing.closer.lifting
        slip = jnp.where(lifting, jnp.linalg.norm(here - reference, axis=-1), 0.0)
        rise = truth.object_pos[:, 2] - base
        judged = update_progress(carry.progress, rise, slip, success, grasper.dt)
        felt = closer.forces(grasp.closing.closer, measured)
        trace = Trace(
            phase=grasp.phase,
            qpos=state.qpos,
            rise=rise,
            tip_error=done.tip_error,
            contacts=done.contacts.position,
            touching=truth.tip_found,
            observed=grasp.closing.closer.observed,
            force=jnp.linalg.norm(truth.finger_force, axis=-1),
            felt=jnp.linalg.norm(felt, axis=-1),
        )
        due = carry.due | done.plans_due
        return _Carry(state, measured, truth, grasp, due, reference, judged), trace

    return jax.lax.scan(tick, carry, length=_SEGMENT)


def _seen(truth: Truth, told: bool) -> Seen:
    """A perfect tracker, and touch flags if the tips tell any."""
    return Seen(
        p_wo=truth.object_pos,
        R_wo=so3.quat_to_mat(truth.object_quat),
        touching=truth.tip_found & told,
        obstacles=jnp.zeros((*truth.object_pos.shape[:-1], 0, 4)),
    )


def _ended(grasp: GraspState) -> Bool[np.ndarray, " w"]:
    held = np.asarray(grasp.clock - grasp.entered[:, Phase.HOLDING]) >= _HOLD_S
    return (np.asarray(grasp.phase) == Phase.FAILED) | (
        (np.asarray(grasp.phase) == Phase.HOLDING) & held
    )


def _planned(
    grasper: Grasper,
    library: Library,
    known: Known,
    seen: Seen,
    q: Float[Array, "w n"],
    avoid: Float[Array, "w 3"],
    key: Array,
    rows: Int[np.ndarray, " k"],
) -> Ways | None:
    """Plans of some worlds, a few at a time in one compiled size."""
    parts, size = [], min(_PLANS_AT_ONCE, len(q))
    for first in range(0, len(rows), size):
        some = rows[np.minimum(np.arange(first, first + size), len(rows) - 1)]
        keys = jax.vmap(lambda row: jax.random.fold_in(key, row))(jnp.asarray(some))
        given = jax.tree.map(lambda leaf, some=some: leaf[some], (known, seen, q, avoid))
        part = _plan(grasper, library, *given, keys)
        kept = min(size, len(rows) - first)
        parts.append(jax.tree.map(lambda leaf, kept=kept: leaf[:kept], part))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@partial(jax.jit, static_argnames="grasper")
def _plan(
    grasper: Grasper,
    library: Library,
    known: Known,
    seen: Seen,
    q: Float[Array, "k n"],
    avoid: Float[Array, "k 3"],
    keys: Array,
) -> Ways | None:
    def one(given: tuple[Known, Seen, Array, Array, Array]) -> Ways | None:
        known, seen, q, avoid, key = given
        return grasper.plan(library, known, seen, q, key, avoid)

    return jax.lax.map(one, (known, seen, q, avoid, keys))


def _spread(found: Ways | None, ways: Ways | None, rows: Int[np.ndarray, " k"]) -> Ways | None:
    """Plans of some worlds among those of all."""
    return jax.tree.map(lambda new, old: old.at[rows].set(new), found, ways)


def _where(mask: Bool[np.ndarray, " w"], new: GraspState, old: GraspState) -> GraspState:
    return jax.tree.map(
        lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old
    )
