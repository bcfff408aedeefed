"""Trials of whole grasps under way, in closed loop with physics, each in a world of its own.

The controller is given what a robot has: its measurements, a tracked object pose, touch flags. The
truth is the judge's alone.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.evaluation.grasps.circumstances import (
    Circumstances,
    belt_start,
    belt_wrench,
    push_wrench,
)
from mjx_grasp.evaluation.grasps.kept import SEGMENT, Trace
from mjx_grasp.evaluation.grasps.plans import Wanted, planned, planned_in_parts, with_plans
from mjx_grasp.evaluation.grasps.tracker import Track, start_track, track
from mjx_grasp.evaluation.grasps.trials import Trial
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import turned
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import GraspState, GraspTick, Known, Seen, Tried, Ways, smoothed
from mjx_grasp.posture.library import Library
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Physics, PhysicsState, Truth, WorldParams
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import Progress, in_palm, initial_progress, slipped, update_progress

_PART = 128
"""Trials that begin, or whose ends are kept, at once: as many as plans are made for on a GPU."""
LEAST_S = 9.0
"""Time for which every trial runs: the length of an end-to-end episode (method §6) [s]."""

Tree = TypeVar("Tree")


class _Carry(NamedTuple):
    """All that goes from tick to tick."""

    physics: PhysicsState
    measured: Measured
    truth: Truth
    grasp: GraspState
    due: Bool[Array, " w"]
    track: Track
    belt_began: Float[Array, " w"]
    """+inf before [s]"""
    reference: Float[Array, "w 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress
    broken: Bool[Array, " w"]
    overflow_ticks: Int[Array, " w"]
    plans: Int[Array, " w"]
    """times that plans were made"""


class _Worlds(NamedTuple):
    """Trials under way, each in a world of its own."""

    known: Known
    of: Trial
    carry: _Carry


class _Control(NamedTuple):
    """What the controllers of all worlds did in a tick, and what is done to the worlds in it."""

    grasp: GraspState
    done: GraspTick
    track: Track
    belt_began: Float[Array, " w"]
    ctrl: Float[Array, "w nu"]
    """position commands [rad]"""
    wrench: Float[Array, "w 6"]
    """on the object at its centre of mass: force [N], torque [N m]"""
    over: Bool[Array, " w"]
    """whose trials were over before"""


class UnderWay:
    """Trials under way, and those that begin."""

    def __init__(
        self,
        grasper: Grasper,
        library: Library | None,
        physics: Physics,
        trials: Trial,
        known: Known,
        which: Int[np.ndarray, " n"],
    ):
        self._grasper, self._library, self._physics = grasper, library, physics
        self._trials, self._known, self._which = trials, known, which
        self._order = jnp.asarray(np.argsort(physics.scene.addresses.robot_ctrl))

    def taken_up(
        self, running: _Worlds, worlds: Int[np.ndarray, " k"], trials: Int[np.ndarray, " k"]
    ) -> _Worlds:
        """Trials begin in worlds in which others have ended."""
        for some, own in zip(_parts(worlds), _parts(trials), strict=True):
            # What fills up a part begins once more where it has begun.
            running = _put(running, self.begun(own), jnp.asarray(some))
        return running

    def begun(self, trials: Int[np.ndarray, " k"]) -> _Worlds:
        """Trials begin, each in a world of its own."""
        of, known = _rows(self._trials, trials), _rows(self._known, self._which[trials])
        known = known._replace(weight=jnp.where(of.given.weighed, known.weight, 0.0))
        tracked = _first_look(of, self._grasper.dt)
        seen, q = _seen(tracked, of.truth, of.given), of.measured.q
        wanted = Wanted(known, seen, q, Tried.nothing(len(q)), _plan_keys(of.key, 0))
        different, same = np.unique(trials, return_index=True, return_inverse=True)[1:]
        ways = planned(self._grasper, self._library, wanted, different)
        ways = jax.tree.map(lambda leaf: leaf[same], ways)
        grasp = _start(self._grasper, of.measured, known, seen, ways)
        ctrl = of.qpos[:, self._physics.scene.addresses.robot_qpos][:, self._order]
        carry = _Carry(
            physics=self._physics.init(of.qpos, ctrl),
            measured=of.measured,
            truth=of.truth,
            grasp=grasp,
            due=jnp.zeros(len(q), bool),
            track=tracked,
            belt_began=jnp.full(len(q), jnp.inf, jnp.float32),
            reference=in_palm(of.measured, of.truth),
            progress=initial_progress((len(q),)),
            broken=jnp.zeros(len(q), bool),
            overflow_ticks=jnp.zeros(len(q), jnp.int32),
            plans=jnp.ones(len(q), jnp.int32),
        )
        return _Worlds(known, of, carry)

    def segment(self, running: _Worlds) -> tuple[_Worlds, Trace, Bool[np.ndarray, " w"]]:
        """Some ticks later: what happened in them, and which trials are over."""
        (known, of, carry), ticks = running, []
        for _ in range(SEGMENT):
            sent = _controlled(self._grasper, carry, known, of, self._order)
            stepped = _stepped(self._physics, carry.physics, of.params, sent)
            carry, tick = _judged(self._grasper, carry, sent, stepped, of)
            ticks.append(tick)
        found = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(ticks))
        return _Worlds(known, of, carry), found, np.array(_over(carry, of.given.hold_s))

    def replanned(self, running: _Worlds, due: Int[np.ndarray, " k"]) -> _Worlds:
        """With new plans where they are due."""
        assert self._library is not None  # plans are due of none without a planner
        known, of, carry = running
        now = _smoothed(carry, of.given)
        state, keys = carry.grasp, _plan_keys(of.key, carry.plans)
        wanted = Wanted(known, now, carry.measured.q, state.tried, keys)
        for rows, ways in planned_in_parts(self._grasper, self._library, wanted, due):
            state = with_plans(self._grasper, state, ways, rows)
        made = np.bincount(due, minlength=len(carry.due))
        carry = carry._replace(grasp=state, due=carry.due & (made == 0), plans=carry.plans + made)
        return _Worlds(known, of, carry)

    def ends(self, running: _Worlds, worlds: Int[np.ndarray, " k"]) -> Any:
        """How trials ended."""
        carry = running.carry
        ends = carry.grasp, carry.progress, carry.plans, carry.broken, carry.overflow_ticks
        found = [jax.device_get(_rows(ends, some)) for some in _parts(worlds)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(worlds)], *found)


def _parts(rows: Int[np.ndarray, " k"]) -> list[Int[np.ndarray, " part"]]:
    """Rows, some at a time, as many as compiled functions are made for; the last fills up."""
    size = _PART * math.ceil(len(rows) / _PART)
    filled = rows[np.minimum(np.arange(size), len(rows) - 1)]
    return np.split(filled, size // _PART) if size else []


def _rows(tree: Tree, rows: Int[np.ndarray, " k"]) -> Tree:
    """Some worlds or trials of all."""
    return _taken(tree, jnp.asarray(rows))


_taken = jax.jit(lambda tree, rows: jax.tree.map(lambda leaf: leaf[rows], tree))


@jax.jit
def _put(running: _Worlds, new: _Worlds, worlds: Int[Array, " k"]) -> _Worlds:
    return jax.tree.map(lambda old, some: old.at[worlds].set(some), running, new)


@partial(jax.jit, static_argnames="dt")
def _first_look(of: Trial, dt: float) -> Track:
    before = start_track(*_pose(of.truth), dt)
    return track(before, *_pose(of.truth), _noise_keys(of.key, 0), of.given.faults)


@jax.jit
def _smoothed(carry: _Carry, given: Circumstances) -> Seen:
    return jax.vmap(smoothed)(_seen(carry.track, carry.truth, given), carry.grasp.pose)


def _plan_keys(keys: Array, number: Int[Array, " w"] | int) -> Array:
    return jax.vmap(jax.random.fold_in)(keys[:, 0], jnp.broadcast_to(number, len(keys)))


def _noise_keys(keys: Array, tick: Int[Array, " w"] | int) -> Array:
    return jax.vmap(jax.random.fold_in)(keys[:, 1], jnp.broadcast_to(tick, len(keys)))


@partial(jax.jit, static_argnames="grasper")
def _start(
    grasper: Grasper, measured: Measured, known: Known, seen: Seen, ways: Ways | None
) -> GraspState:
    return jax.vmap(grasper.start)(measured, known, seen, ways)


@partial(jax.jit, static_argnames="grasper")
def _controlled(
    grasper: Grasper, carry: _Carry, known: Known, of: Trial, order: Int[Array, " n"]
) -> _Control:
    """What is sent to the robots, and acts on the objects, until the next tick."""
    given = of.given
    tick = 1 + jnp.round(carry.grasp.clock / grasper.dt).astype(jnp.int32)
    keys = _noise_keys(of.key, tick)
    tracked = track(carry.track, *_pose(carry.truth), keys, given.faults)
    seen = _seen(tracked, carry.truth, given)
    grasp, done = grasper.ticks(carry.grasp, carry.measured, known, seen)
    began = belt_start(carry.belt_began, grasp.clock, done.tip_error, given.belt)
    p_wo, R_wo = _pose(carry.truth)
    velocity, height = carry.truth.object_vel[:, :3], (p_wo + turned(R_wo, known.com))[:, 2]
    since, rise = grasp.clock - began, p_wo[:, 2] - of.truth.object_pos[:, 2]
    wrench = belt_wrench(given, velocity, rise, height, since)
    holds = grasp.phase == Phase.HOLDING
    held = jnp.where(holds, grasp.clock - grasp.entered[:, Phase.HOLDING], jnp.nan)
    wrench += push_wrench(given, held)
    over = _over(carry, given.hold_s)
    return _Control(grasp, done, tracked, began, done.target[:, order], wrench, over)


@partial(jax.jit, static_argnames="physics")
def _stepped(
    physics: Physics, state: PhysicsState, params: WorldParams, sent: _Control
) -> tuple[PhysicsState, Measured, Truth]:
    """The worlds whose trials are not over, a tick later.

    JAX keeps no compiled function that calls MuJoCo, so this one holds nothing else.
    """
    return physics.step(state, params, sent.ctrl, sent.wrench, ~sent.over)


@partial(jax.jit, static_argnames="grasper")
def _judged(
    grasper: Grasper,
    carry: _Carry,
    sent: _Control,
    stepped: tuple[PhysicsState, Measured, Truth],
    of: Trial,
) -> tuple[_Carry, Trace]:
    """All that goes on to the next tick, and what is kept of this one."""
    success, closer, dt = SuccessConfig(), grasper.closer, grasper.dt
    (state, measured, truth), grasp, over = stepped, sent.grasp, sent.over
    here = in_palm(measured, truth)
    before, lifting = (state.closing.closer.lifting for state in (carry.grasp, grasp))
    reference, slip = slipped(carry.reference, before, lifting, here)
    base = of.truth.object_pos[:, 2]
    rise = truth.object_pos[:, 2] - base
    judged = update_progress(carry.progress, rise, slip, lifting, success, dt)
    due = carry.due | sent.done.plans_due
    full = carry.overflow_ticks + truth.overflow
    went_on = _Carry(
        state, measured, truth, grasp, due, sent.track, sent.belt_began, reference, judged,
        carry.broken, full, carry.plans,
    )  # fmt: skip
    finite = jnp.isfinite(state.qpos).all(-1) & jnp.isfinite(state.qvel).all(-1)
    after = _where(over | ~finite, carry, went_on)
    after = after._replace(broken=carry.broken | (~over & ~finite))
    trace = Trace(
        phase=after.grasp.phase,
        qpos=after.physics.qpos,
        rise=after.truth.object_pos[:, 2] - base,
        object_vel=after.truth.object_vel,
        tip_error=sent.done.tip_error,
        contacts=sent.done.contacts.position,
        touching=after.truth.tip_found,
        observed=after.grasp.closing.closer.observed,
        force=jnp.linalg.norm(after.truth.finger_force, axis=-1),
        felt=jnp.linalg.norm(closer.forces(after.grasp.closing.closer, after.measured), axis=-1),
        over=over,
    )
    return after, trace


def _pose(truth: Truth) -> tuple[Float[Array, "w 3"], Float[Array, "w 3 3"]]:
    return truth.object_pos, so3.quat_to_mat(truth.object_quat)


def _seen(tracked: Track, truth: Truth, given: Circumstances) -> Seen:
    """What the controller is told beside its own measurements."""
    return Seen(
        p_wo=tracked.p_wo,
        R_wo=tracked.R_wo,
        touching=truth.tip_found & given.told[:, None],
        obstacles=given.obstacles,
    )


def _over(carry: _Carry, hold_s: Float[Array, " w"]) -> Bool[Array, " w"]:
    """Which trials are over: failed, or held for long enough, after the time that each one gets."""
    grasp = carry.grasp
    held = grasp.clock - grasp.entered[:, Phase.HOLDING] >= hold_s
    ended = (grasp.phase == Phase.FAILED) | ((grasp.phase == Phase.HOLDING) & held)
    return (ended & (grasp.clock >= LEAST_S - 1e-4)) | carry.broken


def _where(mask: Bool[Array | np.ndarray, " w"], first: Tree, other: Tree) -> Tree:
    """World by world one or the other of two trees."""

    def chosen(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(chosen, first, other)
