"""What came of whole grasps: one row per trial, and their sums per object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.evaluation.grasps.kept import GraspEnd, Trace
from mjx_grasp.evaluation.grasps.trials import GraspProblem
from mjx_grasp.evaluation.grasps.worlds import LEAST_S
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import failure_classes

OUTCOMES = ("success", "not_reached", "never_lifted", "slipped", "not_held", "hit")
"""Of a trial, exclusive; beside the classes of the closing task's judge, what never closed and what
touched an obstacle. What was held but is given up, broken, or not up at its trial's end, is not
held."""


@dataclass(frozen=True)
class GraspRow:
    """One trial."""

    object: str
    outcome: str
    """one of `OUTCOMES`, by the judge"""
    failure: str
    """why the controller itself gave up, a `Failure`; `none` if it has not"""
    handoff_s: float | None
    """from the start to the first handoff [s]"""
    lift_s: float | None
    """to the first lift onset [s]"""
    lifted_s: float | None
    """until the object has risen by what counts as lifted [s]"""
    up_at_9s: bool
    """whether the object is lifted `LEAST_S` after the start"""
    tip_error_mm: tuple[float, ...] | None
    """thumb, index, middle: tips to their standoff targets at the last handoff [mm]"""
    midpoint_mm: float | None
    """of their midpoint [mm]"""
    force_mean_n: float | None
    """mean over fingers and the ticks of lift and hold, without those of reaching anew [N]"""
    force_peak_n: float | None
    """largest on one finger at any time [N]"""
    peak_rise_m: float
    """of the object [m]"""
    returns: int
    """times that closing was left for reaching"""
    replans: int
    """times that new plans were made"""
    broken: bool
    """whether the simulation's state stopped being finite; nothing counts as held then"""
    overflow_ticks: int
    """in which a contact or constraint did not fit the simulation's buffers"""


def grasp_rows(
    names: Sequence[str],
    problem: GraspProblem,
    end: GraspEnd,
    trace: Trace,
    dt: float,
) -> list[GraspRow]:
    """Rows of all trials.

    Args:
        names: Of the scene's objects, in its order.
        problem: What was grasped.
        end: How it ended.
        trace: What happened on the way.
        dt: Control period [s].
    """
    progress = jax.tree.map(jnp.asarray, end.progress)
    classes = {name: np.asarray(flags) for name, flags in failure_classes(progress).items()}
    phase, force = np.asarray(trace.phase), np.asarray(trace.force)
    lifted = np.asarray(trace.rise) >= SuccessConfig().height
    rows = []
    for w, k in enumerate(problem.object_index):
        closed = (phase[:, w] == Phase.CLOSING).any()
        outcome = next((name for name, flags in classes.items() if flags[w]), "success")
        failure = Failure(int(end.state.failure[w]))
        # After a trial's end all stays as it was.
        given_up = failure != Failure.NONE or end.broken[w]
        if outcome == "success" and (given_up or not lifted[-1, w]):
            outcome = "not_held"
        if outcome == "never_lifted" and not closed:
            outcome = "not_reached"
        lift = _first(phase[:, w], Phase.LIFTING, dt)
        carries = np.isin(phase[:, w], (Phase.LIFTING, Phase.HOLDING)) & ~trace.over[:, w]
        carried = force[carries, w]
        peak = float(force[:, w].max())
        rows.append(
            GraspRow(
                object=names[k],
                outcome="hit" if end.hit[w] else outcome,
                failure=failure.name.lower(),
                handoff_s=_first(phase[:, w], Phase.CLOSING, dt),
                lift_s=lift,
                lifted_s=round((int(lifted[:, w].argmax()) + 1) * dt, 3)
                if lifted[:, w].any()
                else None,
                up_at_9s=bool(lifted[min(round(LEAST_S / dt), len(lifted)) - 1, w]),
                tip_error_mm=_millimetres(end.state.handoff.error[w]) if closed else None,
                midpoint_mm=_millimetres(end.state.handoff.midpoint[w, None])[0]
                if closed
                else None,
                force_mean_n=round(float(carried.mean()), 3) if len(carried) else None,
                force_peak_n=round(peak, 3) if peak else None,
                peak_rise_m=round(float(end.progress.peak_rise[w]), 4),
                returns=int(end.state.returns[w]),
                replans=int(end.replans[w]),
                broken=bool(end.broken[w]),
                overflow_ticks=int(end.overflow_ticks[w]),
            )
        )
    return rows


def summed(rows: Sequence[GraspRow]) -> dict[str, Any]:
    """Rates, mean times and errors of some trials."""
    n = len(rows)
    held = [row for row in rows if row.outcome == "success"]
    return {
        "trials": n,
        **{outcome: sum(row.outcome == outcome for row in rows) for outcome in OUTCOMES},
        "success_percent": round(100.0 * len(held) / n, 1),
        "up_at_9s": sum(row.up_at_9s for row in rows),
        "broken": sum(row.broken for row in rows),
        "overflows": sum(row.overflow_ticks for row in rows),
        "ci95": [round(x, 1) for x in wilson_interval(len(held), n)],
        "handoff_s": _mean([row.handoff_s for row in rows]),
        "lift_s": _mean([row.lift_s for row in held]),
        "lifted_s": _mean([row.lifted_s for row in held]),
        "tip_error_mm": [
            _mean([row.tip_error_mm[k] for row in rows if row.tip_error_mm]) for k in range(3)
        ],
        "midpoint_mm": _mean([row.midpoint_mm for row in rows]),
        "force_mean_n": _mean([row.force_mean_n for row in held]),
        "force_peak_n": _mean([row.force_peak_n for row in held]),
    }


def as_record(rows: Sequence[GraspRow]) -> dict[str, Any]:
    """Sums of all, of each object, and the rows, for a results file."""
    names = list(dict.fromkeys(row.object for row in rows))
    return {
        "all": summed(rows),
        "objects": {name: summed([row for row in rows if row.object == name]) for name in names},
        "rows": [asdict(row) for row in rows],
    }


def _first(phase: Int[np.ndarray, " t"], wanted: Phase, dt: float) -> float | None:
    found = phase == wanted
    return round(int(found.argmax()) * dt, 3) if found.any() else None


def _millimetres(lengths: Float[Array | np.ndarray, " n"]) -> tuple[float, ...]:
    return tuple(round(1e3 * float(x), 2) for x in lengths)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 3) if known else None
