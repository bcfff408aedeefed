"""What a reach sweep reports: rates beside the paper's, residuals, failures, limits (method §3)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax import Array

from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.evaluation.reach.record import BUDGETS, TOLERANCES, ReachRecord, share_converged
from mjx_grasp.posture.body import Body
from mjx_grasp.reaching.config import LimitConfig
from mjx_grasp.records.table import Table

Values = np.ndarray | Array
"""Numbers of a sweep, one per pose."""

PAPER_RATE = {
    "10": (0.0, 0.0, 32.6, 69.6, 77.7, 78.9),
    "15": (13.1, 30.2, 61.5, 75.5, 79.1, 79.7),
    "20": (44.2, 50.8, 68.4, 78.3, 79.6, 80.0),
    "30": (53.1, 75.4, 84.9, 88.1, 90.3, 91.5),
    "50": (84.8, 99.2, 99.3, 99.3, 99.3, 99.3),
}
"""The publication's figures, [%], by tolerance in mm, one per budget."""
PAPER_HANDOFF_MM = {
    "thumb": (8.7, 3.5),
    "index": (14.2, 5.0),
    "middle": (17.1, 3.7),
    "midpoint": (5.0, 2.1),
}
"""Its tip errors at handoff: mean and spread."""

FAILURES = ("unreachable", "slow", "limit", "collision", "local minimum")
"""Why a reach did not converge within 20 mm and 3 s; the first that applies."""
_TOLERANCE, _BUDGET = 2, 3  # 20 mm and 3 s, of TOLERANCES and BUDGETS
_TOUCHES, _AT_LIMIT = 0.002, 0.01
_FEW = 5  # of the poses that come nearest
_SLACK = 1e-4
# Distances that differ by less are equal, [m].
_ROUNDING = 1e-6


def classify(
    body: Body,
    limits: LimitConfig,
    record: ReachRecord,
    least_error: Values | None,
) -> np.ndarray:
    """Of each pose the index into :data:`FAILURES`, −1 where it converged.

    A reach that came to rest against what it must not touch is 'collision', else one with a joint
    at its limit is 'limit'; what stays is a local minimum of the fields.

    Args:
        body: The robot.
        limits: That the controller kept.
        record: Of the sweep.
        least_error: Largest tip error of the best collision-free posture, [m]; None if not known.
    """
    tolerance = TOLERANCES[_TOLERANCE]
    time = np.asarray(record.fine_time)[:, _TOLERANCE]
    failed = time > BUDGETS[_BUDGET] + _SLACK
    unreachable = np.zeros(len(failed), bool)
    if least_error is not None:
        unreachable = failed & (np.asarray(least_error) > tolerance)
    slow = np.isfinite(time)
    limit, *touching = held_up_by(body, limits, record).values()
    collision = np.any(touching, axis=0)
    classes = np.select([unreachable, slow, collision, limit], [0, 1, 3, 2], 4)
    return np.where(failed, classes, -1)


def held_up_by(body: Body, limits: LimitConfig, record: ReachRecord) -> dict[str, np.ndarray]:
    """Of each pose what the reach had come up against in the end; several may apply.

    Args:
        body: The robot.
        limits: That the controller kept.
        record: Of the sweep.
    """
    lower, upper = body.within(limits.clearances.joint_limits)
    room = np.minimum(record.q - lower, upper - record.q) - _AT_LIMIT
    last = {"object": record.last_object, "table": record.last_table, "finger": record.last_finger}
    touching = {name: np.asarray(distance) < _TOUCHES for name, distance in last.items()}
    return {"joint limit": np.any(room < 0, axis=1), **touching}


def summary(
    body: Body,
    limits: LimitConfig,
    poses: CylinderPoses,
    record: ReachRecord,
    least_error: Values | None,
) -> dict[str, Any]:
    """All numbers of a sweep, for a results file.

    Args:
        body: The robot.
        limits: That the controller kept.
        poses: The cylinders.
        record: Of the sweep.
        least_error: Of the best collision-free posture of each pose, [m]; None if not known.
    """
    classes = classify(body, limits, record, least_error)
    converged = classes < 0
    clear = np.asarray(record.start_distance) > 0
    result: dict[str, Any] = {
        "poses": len(converged),
        "rate_percent": share_converged(record.fine_time),
        "rate_percent_since_start": share_converged(record.clock),
        "rate_percent_since_first_near": share_converged(_since_first_near(record)),
        "reaches_that_changed_plan_percent": _percent(np.asarray(record.plans_left) > 0),
        "paper_rate_percent": {
            k: dict(zip((f"{b:g}" for b in BUDGETS), v, strict=True)) for k, v in PAPER_RATE.items()
        },
        "at_20mm_3s": {
            "upright": _percent(converged[~poses.lying]),
            "lying": _percent(converged[poses.lying]),
            "started_clear": _percent(converged[clear]),
            "started_in_contact": _percent(converged[~clear]),
            "share_started_in_contact": _percent(~clear),
        },
        "failures_percent": {name: _percent(classes == k) for k, name in enumerate(FAILURES)},
        "seconds_to_20mm": _percentiles(record.clock[:, _TOLERANCE]),
        "fine_seconds_to_10mm": _percentiles(record.fine_time[:, 0]),
        "handoff_mm": _handoff(record),
        "limits": _limits(record, limits),
        "nearest_poses": _nearest(record, limits),
    }
    if least_error is not None:
        least = np.asarray(least_error)
        solvable = {f"{1e3 * t:g}": least <= t for t in TOLERANCES}
        result["solvable_percent"] = {k: _percent(v) for k, v in solvable.items()}
        result["rate_percent_of_solvable"] = {
            k: share_converged(np.asarray(record.fine_time)[ok])[k]
            for k, ok in solvable.items()
            if ok.any()
        }
    return result


def _since_first_near(record: ReachRecord) -> np.ndarray:
    """Times of the first convergence as if the fine-adjustment timer were never set back, [s]."""
    clock, near = np.asarray(record.clock), np.asarray(record.near)[:, None]
    there = np.isfinite(clock)
    return np.where(there, np.where(there, clock, 0.0) - np.where(there, near, 0.0), np.inf)


def _percent(mask: Values) -> float | None:
    return round(100.0 * float(np.mean(mask)), 3) if len(mask) else None


def _percentiles(values: Values) -> dict[str, float | None]:
    """Some percentiles; None where the reach never came that far."""
    found = {}
    for p in (50, 90, 95, 99):
        value = np.percentile(values, p, method="higher")
        found[f"{p}"] = round(float(value), 3) if np.isfinite(value) else None
    return found


def _handoff(record: ReachRecord) -> dict[str, Any]:
    """Tip errors at handoff, and distances to the contacts themselves, [mm]."""
    there = np.isfinite(record.handoff_time)
    result: dict[str, Any] = {"share_percent": _percent(there)}
    if not there.any():
        return result
    rows = {
        name: record.handoff_error[there, k] for k, name in enumerate(("thumb", "index", "middle"))
    }
    rows["midpoint"] = record.handoff_midpoint[there]
    for name, values in rows.items():
        result[name] = {
            "mean": round(1e3 * float(values.mean()), 3),
            "std": round(1e3 * float(values.std()), 3),
            "median": round(1e3 * float(np.median(values)), 3),
            "paper": PAPER_HANDOFF_MM[name],
        }
    contact = np.median(record.handoff_contact[there], axis=0)
    result["to_contact_median"] = [round(1e3 * float(c), 3) for c in contact]
    result["seconds_median"] = round(float(np.median(record.handoff_time[there])), 3)
    return result


def _limits(record: ReachRecord, limits: LimitConfig) -> dict[str, Any]:
    """The worst of every tick of every reach, and of those that start alike.

    ``safe`` starts are as far from the object as is asked for, ``near`` ones are nearer,
    ``in_contact`` ones touch it; their distances count from when they are first clear. ``Lost``
    is how much nearer a reach ever was than at its start, or than is asked for if that is less.
    """
    start, asked = np.asarray(record.start_distance), limits.clearances.object
    starts = {
        "all": np.ones(len(start), bool),
        "safe": start >= asked,
        "near": (start > 0) & (start < asked),
        "in_contact": start <= 0,
    }
    return {name: _worst(record, rows, asked) for name, rows in starts.items()}


def _worst(record: ReachRecord, rows: np.ndarray, asked: float) -> dict[str, float | int | None]:
    """The worst of some reaches."""

    def least(values: Values) -> float | None:
        chosen = np.asarray(values)[rows]
        return _millimetres(chosen.min()) if np.isfinite(chosen).any() else None

    def largest(values: Values) -> float:
        return round(max(float(np.max(np.asarray(values)[rows], initial=0.0)), 0.0), 6)

    nearest = np.asarray(record.object_distance)[rows]
    start = np.asarray(record.start_distance)[rows]
    lost = np.where(start > 0, np.minimum(start, asked) - nearest, 0.0)
    infeasible = np.asarray(record.infeasible)[rows]
    return {
        "reaches": int(rows.sum()),
        "ticks": int(np.asarray(record.ticks)[rows].sum()),
        "largest_speed_over_limit": largest(record.speed_ratio),
        "farthest_beyond_joint_limit_rad": largest(record.limit_excess),
        "least_object_distance_mm": least(record.object_distance),
        "reaches_nearer_than_asked": int((nearest < asked - _ROUNDING).sum()),
        "deepest_start_mm": _millimetres(max(np.max(-start, initial=0.0), 0.0)),
        "most_object_distance_lost_mm": _millimetres(max(np.max(lost, initial=0.0), 0.0)),
        "least_table_height_over_asked_mm": least(record.table_margin),
        "least_finger_distance_mm": least(record.finger_distance),
        "least_arm_to_itself_mm": least(record.arm_distance),
        "ticks_infeasible": int(infeasible.sum()),
        "reaches_with_infeasible_ticks": int((infeasible > 0).sum()),
    }


def _millimetres(length: float | np.floating) -> float:
    return round(1e3 * float(length), 3)


def _nearest(record: ReachRecord, limits: LimitConfig) -> dict[str, float]:
    """Of the poses that started at a safe distance those that came nearest, [mm]."""
    safe = np.flatnonzero(np.asarray(record.start_distance) >= limits.clearances.object)
    distance = np.asarray(record.object_distance)[safe]
    order = np.argsort(distance, kind="stable")[:_FEW]
    return {str(safe[k]): _millimetres(distance[k]) for k in order}


def tables(result: dict[str, Any], label: str) -> tuple[Table, Table, str]:
    """What the command prints: rates, tip errors, and why reaches failed."""
    return rate_table(result, label), residual_table(result, label), failure_line(result)


def rate_table(result: dict[str, Any], label: str) -> Table:
    """The table of method §3 with the paper's figures beside ours, [%]."""
    header = ("mm", "", *(f"{b:g} s" for b in BUDGETS), "solvable")
    rows = []
    for tolerance, ours in result["rate_percent"].items():
        solvable = result.get("solvable_percent", {}).get(tolerance)
        share = "" if solvable is None else f"{solvable:.1f}"
        rows.append((tolerance, label, *(f"{v:.1f}" for v in ours.values()), share))
        paper = PAPER_RATE[tolerance]
        rows.append(("", "published", *(f"{v:.1f}" for v in paper), ""))
    title = f"Reaches converged, % of {result['poses']} poses, by tolerance and fine-adjusting time"
    return Table(title, header, tuple(rows), names=2)


def residual_table(result: dict[str, Any], label: str) -> Table:
    """Tip errors at handoff beside the paper's, [mm]."""
    handoff = result["handoff_mm"]
    names = [name for name in PAPER_HANDOFF_MM if name in handoff]
    ours = tuple(f"{handoff[n]['mean']:.1f} ± {handoff[n]['std']:.1f}" for n in names)
    median = tuple(f"{handoff[n]['median']:.1f}" for n in names)
    paper = tuple("{:.1f} ± {:.1f}".format(*PAPER_HANDOFF_MM[n]) for n in names)
    rows = ((label, *ours), (f"{label}, median", *median), ("published", *paper))
    return Table("Tip errors at handoff, mm", ("", *names), rows)


def failure_line(result: dict[str, Any]) -> str:
    """How many reaches failed, by class."""
    shares = [
        f"{name} {share:.1f} %" for name, share in result["failures_percent"].items() if share
    ]
    return f"failures at 20 mm and 3 s: {', '.join(shares) or 'none'}"
