"""Closed-loop rollouts of the `Grasper` in physics, all trials together.

The controller is given what a robot has: its measurements, a tracked object pose, touch flags. The
truth is the judge's alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.evaluation.grasps.circumstances import (
    Circumstances,
    belt_start,
    belt_wrench,
    circumstances,
    push_wrench,
)
from mjx_grasp.evaluation.grasps.hits import hits
from mjx_grasp.evaluation.grasps.plans import Wanted, planned, planned_in_parts, with_plans
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.evaluation.grasps.tracker import Track, start_track, track
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import turned
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import GraspState, GraspTick, Known, Seen, Tried, Ways, smoothed
from mjx_grasp.posture.body import FINGERS
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.fields import midpoint
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.physics import Physics, PhysicsState, Truth, WorldParams, make_params
from mjx_grasp.sim.scene import Scene
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import Progress, in_palm, initial_progress, slipped, update_progress

_SEGMENT = 10
"""Ticks between two looks for worlds that want new plans: the time that planning takes."""
LEAST_S = 9.0
"""Time for which every trial runs: the length of an end-to-end episode (method §6) [s]."""


Tree = TypeVar("Tree")


class GraspProblem(NamedTuple):
    """What is grasped in each trial; world frame."""

    object_index: Int[np.ndarray, " w"]
    """into the scene's objects"""
    p_wo: Float[np.ndarray, "w 3"]
    """object origin at the start [m]"""
    quat: Float[np.ndarray, "w 4"]
    """its rotation, w-x-y-z"""
    headings: Float[np.ndarray, "w 2"]
    """from x about z, of what carries it and of what pushes it, if anything does [rad]"""


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
    over: Bool[Array, "t w"]
    """whether the trial had ended before; then all stays as it was"""


class GraspEnd(NamedTuple):
    """How the trials ended."""

    state: GraspState
    progress: Progress
    replans: Int[np.ndarray, " w"]
    """times that new plans were made"""
    obstacles: Float[np.ndarray, "w k 4"]
    """that hung in the way: centre and radius [m]"""
    hit: Bool[np.ndarray, " w"]
    """whether the robot touched one of them"""
    broken: Bool[np.ndarray, " w"]
    """whether its state stopped being finite; it ended with the tick before"""
    overflow_ticks: Int[np.ndarray, " w"]
    """in which a contact or constraint did not fit the engine's buffers"""


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
    key: Array
    """of the tracker's noise"""
    reference: Float[Array, "w 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress
    broken: Bool[Array, " w"]
    overflow_ticks: Int[Array, " w"]


class _Control(NamedTuple):
    """What the controllers of all worlds did in a tick, and what is done to the worlds in it."""

    grasp: GraspState
    done: GraspTick
    track: Track
    belt_began: Float[Array, " w"]
    key: Array
    ctrl: Float[Array, "w nu"]
    """position commands [rad]"""
    wrench: Float[Array, "w 6"]
    """on the object at its centre of mass: force [N], torque [N m]"""
    over: Bool[Array, " w"]
    """whose trials were over before"""


def home_tips(grasper: Grasper) -> Float[np.ndarray, " 3"]:
    """Midpoint of the fingertips at home, world frame [m]."""
    body = grasper.reacher.body
    return np.asarray(midpoint(body.kinematics.motion(jnp.asarray(body.home)).pos[:FINGERS]))


def grasp_all(
    grasper: Grasper,
    library: Library | None,
    physics: Physics,
    known: Known,
    problem: GraspProblem,
    scenarios: Sequence[Scenario] = (Scenario(),),
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[GraspEnd, Trace]:
    """Grasps from home, until every trial has ended; none goes on because another one does.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        physics: Of the scene with all objects of the problem, as many worlds as there are trials.
        known: Of each trial's object, stacked.
        problem: Objects and where they are.
        scenarios: What happens meanwhile; by default nothing. Several have equal shares of the
            trials, one after the other, and as many obstacles each.
        seed: Of the plans and of the tracker's noise.
        progress: Told which share of the longest possible time is done.
    """
    scene, worlds = physics.scene, len(problem.object_index)
    at, dt, friction = scene.addresses, grasper.dt, scene.config.friction[0]
    given = _given(grasper, scene, problem, scenarios)
    known = known._replace(weight=jnp.where(given.weighed, known.weight, 0.0))
    home = np.asarray(grasper.reacher.body.home, np.float32)
    qpos = np.zeros((worlds, scene.model.nq), np.float32)
    qpos[:, at.robot_qpos] = home
    qpos[:, at.object_qpos] = np.concatenate([problem.p_wo, problem.quat], axis=1)
    params = make_params(jnp.asarray(problem.object_index), friction, given.mass_scale)
    measured, truth = at_rest(scene, qpos, physics.substeps)
    order = np.argsort(at.robot_ctrl)
    ctrl = jnp.broadcast_to(jnp.asarray(home[order]), (worlds, len(home)))

    key, noise = jax.random.split(jax.random.key(seed))
    first = jax.random.fold_in(noise, 0)
    tracked = track(start_track(*_pose(truth), dt), *_pose(truth), first, given.faults)
    seen = _seen(tracked, truth, given)
    wanted = Wanted(known, seen, measured.q, Tried.nothing(worlds))
    plans = planned(grasper, library, wanted, key, np.arange(worlds))
    grasp = _start(grasper, measured, known, seen, plans)
    carry = _Carry(
        physics=physics.init(jnp.asarray(qpos), ctrl),
        measured=measured,
        truth=truth,
        grasp=grasp,
        due=jnp.zeros(worlds, bool),
        track=tracked,
        belt_began=jnp.full(worlds, jnp.inf, jnp.float32),
        key=noise,
        reference=in_palm(measured, truth),
        progress=initial_progress((worlds,)),
        broken=jnp.zeros(worlds, bool),
        overflow_ticks=jnp.zeros(worlds, jnp.int32),
    )
    about = jnp.asarray(order), jnp.asarray(problem.p_wo[:, 2])
    replans, ticks = np.zeros(worlds, int), []
    longest = grasper.config.timeout_s + max(each.hold_s for each in scenarios) + 2.0
    for number in range(round(longest / dt / _SEGMENT)):
        for _ in range(_SEGMENT):
            sent = _controlled(grasper, carry, known, given, *about)
            stepped = _stepped(physics, carry.physics, params, sent)
            carry, tick = _judged(grasper, carry, sent, stepped, about[1])
            ticks.append(tick)
        ticks[-_SEGMENT:] = jax.device_get(ticks[-_SEGMENT:])
        progress(number * _SEGMENT * dt / longest)
        over = np.asarray(_over(carry, given.hold_s))
        if np.all(over):
            break
        due = np.flatnonzero(carry.due & ~over)
        if len(due):
            assert library is not None  # plans are due of none without a planner
            key = jax.random.fold_in(key, number)
            now = jax.vmap(smoothed)(_seen(carry.track, carry.truth, given), carry.grasp.pose)
            state = carry.grasp
            wanted = Wanted(known, now, carry.measured.q, state.tried)
            for rows, ways in planned_in_parts(grasper, library, wanted, key, due):
                state = with_plans(grasper, state, ways, rows)
            carry = carry._replace(grasp=state, due=jnp.zeros(worlds, bool))
            replans[due] += 1
    grasp, judged = jax.tree.map(np.asarray, (carry.grasp, carry.progress))
    incidents = np.asarray(carry.broken), np.asarray(carry.overflow_ticks)
    trace = jax.tree.map(lambda *leaves: np.stack(leaves), *ticks)
    obstacles = np.asarray(given.obstacles)
    hit = hits(scene.robot, trace.qpos[:, :, at.robot_qpos], obstacles)
    return GraspEnd(grasp, judged, replans, obstacles, hit, *incidents), trace


def _given(
    grasper: Grasper, scene: Scene, problem: GraspProblem, scenarios: Sequence[Scenario]
) -> Circumstances:
    """What happens in each trial."""
    tips, friction = home_tips(grasper), scene.config.friction[0]
    mass = np.array([obj.mass for obj in scene.objects])[problem.object_index]
    of_each = [np.split(x, len(scenarios)) for x in (problem.p_wo, problem.headings, mass)]
    parts = [
        circumstances(scenario, p_wo, headings, mass, friction, tips, grasper.dt)
        for scenario, p_wo, headings, mass in zip(scenarios, *of_each, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@partial(jax.jit, static_argnames="grasper")
def _start(
    grasper: Grasper, measured: Measured, known: Known, seen: Seen, ways: Ways | None
) -> GraspState:
    return jax.vmap(grasper.start)(measured, known, seen, ways)


@partial(jax.jit, static_argnames="grasper")
def _controlled(
    grasper: Grasper, carry: _Carry, known: Known, given: Circumstances, order: Int[Array, " n"],
    base: Float[Array, " w"],
) -> _Control:  # fmt: skip
    """What is sent to the robots, and acts on the objects, until the next tick."""
    key, noise = jax.random.split(carry.key)
    tracked = track(carry.track, *_pose(carry.truth), noise, given.faults)
    seen = _seen(tracked, carry.truth, given)
    grasp, done = grasper.ticks(carry.grasp, carry.measured, known, seen)
    began = belt_start(carry.belt_began, grasp.clock, done.tip_error, given.belt)
    p_wo, R_wo = _pose(carry.truth)
    velocity, height = carry.truth.object_vel[:, :3], (p_wo + turned(R_wo, known.com))[:, 2]
    since = grasp.clock - began
    wrench = belt_wrench(given, velocity, p_wo[:, 2] - base, height, since)
    holds = grasp.phase == Phase.HOLDING
    held = jnp.where(holds, grasp.clock - grasp.entered[:, Phase.HOLDING], jnp.nan)
    wrench += push_wrench(given, held)
    over = _over(carry, given.hold_s)
    return _Control(grasp, done, tracked, began, key, done.target[:, order], wrench, over)


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
    base: Float[Array, " w"],
) -> tuple[_Carry, Trace]:
    """All that goes on to the next tick, and what is kept of this one."""
    success, closer, dt = SuccessConfig(), grasper.closer, grasper.dt
    (state, measured, truth), grasp, over = stepped, sent.grasp, sent.over
    here = in_palm(measured, truth)
    before, lifting = (state.closing.closer.lifting for state in (carry.grasp, grasp))
    reference, slip = slipped(carry.reference, before, lifting, here)
    rise = truth.object_pos[:, 2] - base
    judged = update_progress(carry.progress, rise, slip, lifting, success, dt)
    due = carry.due | sent.done.plans_due
    full = carry.overflow_ticks + truth.overflow
    went_on = _Carry(
        state, measured, truth, grasp, due, sent.track, sent.belt_began, sent.key, reference,
        judged, carry.broken, full,
    )  # fmt: skip
    finite = jnp.isfinite(state.qpos).all(-1) & jnp.isfinite(state.qvel).all(-1)
    after = _where(over | ~finite, carry, went_on)
    after = after._replace(broken=carry.broken | (~over & ~finite))
    trace = Trace(
        phase=after.grasp.phase,
        qpos=after.physics.qpos,
        rise=after.truth.object_pos[:, 2] - base,
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
    """World by world one or the other of two trees; what is of no world is the other's."""

    def chosen(a: Array, b: Array) -> Array:
        if not b.ndim:
            return b
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(chosen, first, other)
