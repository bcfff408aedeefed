"""Many reaches at once by kinematic integration: what the reach sweep measures (method §3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import Candidates, cylinder_candidates
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import Library, Planner, Search
from mjx_grasp.reaching.state import Plans, ReachOutcome, ReachState, ReachTick

TOLERANCES = (0.010, 0.015, 0.020, 0.030, 0.050)
"""Of the table, [m]."""
BUDGETS = (0.5, 1.0, 2.0, 3.0, 5.0, 7.0)
"""Of the fine-adjustment timer, [s]."""
SLOW = 0.025
"""Speed below which a tip has arrived, [m/s]."""
_SEGMENT = 100


class ReachRecord(NamedTuple):
    """What is kept of each reach."""

    fine_time: Float[Array, " tolerances"]
    """by tolerance: least fine-adjustment timer when converged, inf if it never was [s]"""
    clock: Float[Array, " tolerances"]
    """by tolerance: time since the start then [s]"""
    near: Float[Array, ""]
    """time since the start when the timer first ran, inf if it never did [s]"""
    plans_left: Int[Array, ""]
    """plans given up for another"""
    handoff_error: Float[Array, " 3"]
    """tip frames to standoff targets at handoff, NaN without one [m]"""
    handoff_contact: Float[Array, " 3"]
    """tip frames to the contacts themselves [m]"""
    handoff_midpoint: Float[Array, ""]
    """of midpoints [m]"""
    handoff_time: Float[Array, ""]
    """since the start [s]"""
    start_distance: Float[Array, ""]
    """of robot and object at the start, negative in contact [m]"""
    been_clear: Bool[Array, ""]
    """whether they have been apart since"""
    object_distance: Float[Array, ""]
    """least from when it was first clear [m]"""
    table_margin: Float[Array, ""]
    """least height over what is asked for [m]"""
    finger_distance: Float[Array, ""]
    """least of two fingers [m]"""
    arm_distance: Float[Array, ""]
    """least of the arm to itself [m]"""
    speed_ratio: Float[Array, ""]
    """largest joint speed over its limit [-]"""
    limit_excess: Float[Array, ""]
    """farthest beyond a joint limit [rad]"""
    infeasible: Int[Array, ""]
    """ticks without a solution"""
    ticks: Int[Array, ""]
    """ticks until the end"""
    last_object: Float[Array, ""]
    """of robot and object at the end, over what is asked for [m]"""
    last_table: Float[Array, ""]
    """height above the table at the end, over what is asked for [m]"""
    last_finger: Float[Array, ""]
    """of two fingers at the end, over what is asked for [m]"""
    q: Float[Array, " joints"]
    """at the end [rad]"""
    best_q: Float[Array, " joints"]
    """where the largest tip error was least [rad]"""
    best_error: Float[Array, ""]
    """that error [m]"""


class Problem(NamedTuple):
    """One cylinder to reach for; world frame."""

    shape: Cylinder
    """the cylinder"""
    p_wo: Float[Array, " 3"]
    """its centre [m]"""
    R_wo: Float[Array, "3 3"]
    """its rotation"""
    plans: Plans | None
    """ways to reach it, or None"""


_Reached = tuple[ReachState, Float[Array, " joints"], ReachRecord]
"""A reach under way: state, configuration [rad], record."""


def candidates_of(reacher: Reacher, shape: Cylinder) -> Candidates:
    """Candidates on a cylinder for a robot's hand."""
    return cylinder_candidates(shape.radius, shape.half_length, reacher.body.robot.hand.span)


def plan_all(
    planner: Planner,
    library: Library,
    poses: CylinderPoses,
    chunk: int,
    progress: Callable[[int], None] = lambda poses: None,
    keys: Array | None = None,
) -> Search:
    """Plans for every pose from home, in chunks of one compiled size.

    Args:
        planner: Of the controller.
        library: From :func:`start_library`.
        poses: The cylinders.
        chunk: Poses at a time.
        progress: Told of every chunk how many it has.
        keys: Of each pose; by default those of the first ones from the planner's seed.
    """
    count = len(poses.radius)
    if keys is None:
        keys = plan_keys(planner, count)
    found = []
    for first in range(0, count, chunk):
        rows = _rows(first, chunk, count)
        shape = Cylinder(poses.radius[rows], poses.half_length[rows])
        part = _plans(planner, library, shape, poses.p_wo[rows], poses.R_wo[rows], keys[rows])
        kept = min(chunk, count - first)
        found.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], part))
        progress(kept)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def plan_keys(planner: Planner, count: int) -> Array:
    """Of every pose, from the planner's seed."""
    return jax.random.split(jax.random.key(planner.config.seed), count)


@partial(jax.jit, static_argnames="planner")
def _plans(
    planner: Planner,
    library: Library,
    shape: Cylinder,
    p_wo: Float[Array, "n 3"],
    R_wo: Float[Array, "n 3 3"],
    keys: Array,
) -> Search:
    home = jnp.asarray(planner.reacher.body.home)

    def one(
        shape: Cylinder, p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"], key: Array
    ) -> Search:
        around = Surroundings.still(shape, p_wo, R_wo)
        return planner.search(library, candidates_of(planner.reacher, shape), around, home, key)

    return jax.vmap(one)(shape, p_wo, R_wo, keys)


def _rows(first: int, chunk: int, count: int) -> np.ndarray:
    """Indices of a chunk; the last one is filled up by repetition, for one compilation."""
    return np.minimum(np.arange(first, first + chunk), count - 1)


def sweep(
    reacher: Reacher,
    poses: CylinderPoses,
    plans: Plans | None,
    chunk: int,
    progress: Callable[[int], None] = lambda ticks: None,
) -> ReachRecord:
    """Reaches for every pose from home until each has ended; arrays of NumPy.

    Args:
        reacher: The controller; its time-outs end a reach.
        poses: The cylinders.
        plans: For every pose, or None.
        chunk: Poses at a time.
        progress: Told of every pose-tick done.
    """
    count = len(poses.radius)
    longest = int(np.ceil(reacher.config.controller.timeout / reacher.config.controller.dt))
    records = []
    for first in range(0, count, chunk):
        rows = _rows(first, chunk, count)
        problem = Problem(
            Cylinder(poses.radius[rows], poses.half_length[rows]),
            poses.p_wo[rows],
            poses.R_wo[rows],
            jax.tree.map(lambda leaf, rows=rows: leaf[rows], plans),
        )
        state = _begun(reacher, problem)
        kept = min(chunk, count - first)
        for tick in range(0, longest, _SEGMENT):
            state = _gone_on(reacher, problem, state)
            progress(kept * min(_SEGMENT, longest - tick))
            if np.all(np.asarray(state[0].outcome) != ReachOutcome.RUNNING):
                progress(kept * max(longest - tick - _SEGMENT, 0))
                break
        records.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], state[2]))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *records)


@partial(jax.jit, static_argnames="reacher")
def _begun(reacher: Reacher, problem: Problem) -> _Reached:
    return jax.vmap(partial(_begin, reacher))(problem)


@partial(jax.jit, static_argnames="reacher")
def _gone_on(reacher: Reacher, problem: Problem, state: _Reached) -> _Reached:
    return jax.vmap(partial(_segment, reacher))(problem, state)


def _begin(reacher: Reacher, problem: Problem) -> _Reached:
    q = jnp.asarray(reacher.body.home)
    candidates = candidates_of(reacher, problem.shape)
    state = reacher.start(q, candidates, problem.p_wo, problem.R_wo, problem.plans)
    return state, q, empty_record(len(q))


def empty_record(joints: int) -> ReachRecord:
    """Before the first tick: infinite, but for what is no least of all ticks."""
    many, nan = jnp.full(len(TOLERANCES), jnp.inf), jnp.full(3, jnp.nan)
    return ReachRecord(*[jnp.float32(jnp.inf)] * len(ReachRecord._fields))._replace(
        fine_time=many,
        clock=many,
        plans_left=jnp.int32(0),
        handoff_error=nan,
        handoff_contact=nan,
        handoff_midpoint=jnp.float32(jnp.nan),
        handoff_time=jnp.float32(jnp.nan),
        been_clear=jnp.asarray(False),
        speed_ratio=jnp.float32(0.0),
        limit_excess=jnp.float32(0.0),
        infeasible=jnp.int32(0),
        ticks=jnp.int32(0),
        q=jnp.zeros(joints),
        best_q=jnp.zeros(joints),
    )


def _segment(reacher: Reacher, problem: Problem, carry: _Reached) -> _Reached:
    candidates = candidates_of(reacher, problem.shape)
    none = jnp.zeros((0, 4))

    def step(carry: _Reached, _: None) -> tuple[_Reached, None]:
        state, q, record = carry
        running = state.outcome == ReachOutcome.RUNNING
        after, tick = reacher.tick(
            state,
            q,
            problem.shape,
            candidates,
            problem.p_wo,
            problem.R_wo,
            none,
            problem.plans,
        )
        q_after = q + reacher.config.controller.dt * tick.velocity
        new = recorded(reacher, record, after, tick, q, q_after)
        record = jax.tree.map(lambda a, b: jnp.where(running, a, b), new, record)
        return (after, q_after, record), None

    return jax.lax.scan(step, carry, length=_SEGMENT)[0]


def recorded(
    reacher: Reacher,
    record: ReachRecord,
    state: ReachState,
    tick: ReachTick,
    q: Float[Array, " joints"],
    q_after: Float[Array, " joints"],
) -> ReachRecord:
    """The record after one more tick of a reach that is under way.

    Args:
        reacher: The controller.
        record: So far.
        state: After the tick.
        tick: What it did.
        q: Configuration before it, [rad].
        q_after: After it, [rad].
    """
    body, config, report = reacher.body, reacher.config, tick.report
    error = jnp.where(tick.targets.valid, jnp.max(report.error), jnp.inf)
    tolerance = jnp.asarray(TOLERANCES)
    converged = (error <= tolerance) & (jnp.max(report.speed) < SLOW)
    first = converged & ~jnp.isfinite(record.clock)
    hands_off = tick.ready & ~jnp.isfinite(record.handoff_time)
    contact = jnp.linalg.norm(tick.tips - tick.targets.position, axis=-1)
    clear = report.object_distance > 0
    first_tick = record.ticks == 0
    been_clear = record.been_clear | clear
    beyond = jnp.maximum(body.lower - q_after, q_after - body.upper)
    better = error < record.best_error
    limits = config.limits
    return ReachRecord(
        fine_time=jnp.where(
            converged, jnp.minimum(state.timer, record.fine_time), record.fine_time
        ),
        clock=jnp.where(first, state.clock, record.clock),
        near=jnp.where(state.timer > 0, jnp.minimum(record.near, state.clock), record.near),
        plans_left=jnp.maximum(record.plans_left, state.tries),
        handoff_error=jnp.where(hands_off, report.error, record.handoff_error),
        handoff_contact=jnp.where(hands_off, contact, record.handoff_contact),
        handoff_midpoint=jnp.where(hands_off, report.midpoint, record.handoff_midpoint),
        handoff_time=jnp.where(hands_off, state.clock, record.handoff_time),
        start_distance=jnp.where(first_tick, report.object_distance, record.start_distance),
        been_clear=been_clear,
        object_distance=jnp.where(
            been_clear,
            jnp.minimum(record.object_distance, report.object_distance),
            record.object_distance,
        ),
        table_margin=jnp.minimum(record.table_margin, report.table_margin),
        finger_distance=jnp.minimum(record.finger_distance, report.finger_distance),
        arm_distance=jnp.minimum(record.arm_distance, report.arm_distance),
        speed_ratio=jnp.maximum(
            record.speed_ratio, jnp.max(jnp.abs(tick.velocity) / body.velocity_limit)
        ),
        limit_excess=jnp.maximum(record.limit_excess, jnp.max(beyond)),
        infeasible=state.infeasible,
        ticks=record.ticks + 1,
        last_object=report.object_distance - limits.clearances.object,
        last_table=report.table_margin,
        last_finger=report.finger_distance - limits.clearances.fingers,
        q=q_after,
        best_q=jnp.where(better, q, record.best_q),
        best_error=jnp.minimum(error, record.best_error),
    )


def share_converged(
    time: Float[np.ndarray | Array, "n tolerances"],
) -> dict[str, dict[str, float]]:
    """``rate_percent[tolerance in mm][budget in s]`` of times of first convergence."""
    slack = 1e-4  # the timer is a sum of float32
    return {
        f"{1e3 * tolerance:g}": {
            f"{budget:g}": float(100.0 * np.mean(time[:, k] <= budget + slack))
            for budget in BUDGETS
        }
        for k, tolerance in enumerate(TOLERANCES)
    }
