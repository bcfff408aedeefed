"""What is kept of a reach tick by tick, and how many have converged by a time (method §3)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.state import ReachState, ReachTick

TOLERANCES = (0.010, 0.015, 0.020, 0.030, 0.050)
"""Of the table, [m]."""
BUDGETS = (0.5, 1.0, 2.0, 3.0, 5.0, 7.0)
"""Of the fine-adjustment timer, [s]."""
SLOW = 0.025
"""Speed below which a tip has arrived, [m/s]."""


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
