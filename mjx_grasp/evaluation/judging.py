"""Controllers compared at equal force, and within a budget of force, from the same starts.

A harder squeeze lifts almost everything, so success says something beside its force only. Trials
from one start state often end alike: what is drawn anew for an interval is the start states.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.results import OUTCOMES, ResultRow
from mjx_grasp.evaluation.statistics import Interval

RESAMPLES = 2_000


class SameStarts(NamedTuple):
    """Trials of c controllers from the same n starts."""

    success: Bool[np.ndarray, "c n"]
    force: Float[np.ndarray, "c n"]
    """mean finger force from lift onset [N]; nan where no lift began"""
    object: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " n"]
    """start state, within its object"""


class Estimate(NamedTuple):
    """A number and its bootstrap 95 % interval."""

    value: float
    ci95: Interval

    def sign(self) -> int:
        """1 or -1 where the interval, as it is written, is above or below nothing; else 0."""
        low, high = (round(limit, 1) for limit in self.ci95)
        return (low > 0.0) - (high < 0.0)

    def text(self) -> str:
        """As a difference in points."""
        low, high = self.ci95
        return f"{self.value:+.1f} ({low:+.1f} to {high:+.1f})"


Weights = Float[np.ndarray, "r n"]
"""How much each trial counts, in what was run (first) and in each resampling of its starts."""


def same_starts(controllers: Sequence[Sequence[ResultRow]]) -> SameStarts:
    """Trials of controllers side by side.

    Args:
        controllers: The rows of each, one per object.

    Raises:
        InputError: Their objects or starts differ, or outcomes, forces or starts were not kept.
    """
    ordered = [sorted(rows, key=lambda row: row.object) for rows in controllers]
    starts = [[(row.object, row.starts) for row in rows] for rows in ordered]
    whole = all(r.outcomes and r.forces_n and r.starts for rows in ordered for r in rows)
    if not ordered or not whole or any(other != starts[0] for other in starts):
        raise InputError("rows", "trials without starts or from others", "trials of the same ones")
    lengths = [row.episodes for row in ordered[0]]
    return SameStarts(
        np.array(
            [[c == OUTCOMES["successes"] for r in rows for c in r.outcomes] for rows in ordered]
        ),
        np.array([[f for r in rows for f in r.forces_n] for rows in ordered], float),
        np.repeat(np.arange(len(lengths)), lengths),
        np.array([start for row in ordered[0] for start in row.starts]),
    )


def resampled(trials: SameStarts, resamples: int = RESAMPLES) -> Weights:
    """Weights of the trials as they were run, then with each object's start states drawn anew.

    Every object counts the same. Trials of one start state are drawn together.

    Args:
        trials: Whose starts.
        resamples: How many.

    Returns:
        Not to be written to: whoever asks for the same gets the same.
    """
    objects, starts = (ids.astype(np.int64).tobytes() for ids in (trials.object, trials.start))
    return _resampled(objects, starts, resamples)


@lru_cache(maxsize=4)
def _resampled(objects: bytes, starts: bytes, resamples: int) -> Weights:
    """As `resampled`, of the bytes of its arrays: most tables are of the same starts many times."""
    of, start = np.frombuffer(objects, np.int64), np.frombuffer(starts, np.int64)
    rng = np.random.default_rng(0)
    weights = np.empty((resamples + 1, len(of)))
    kinds = np.unique(of)
    for k in kinds:
        members = np.flatnonzero(of == k)
        states, state = np.unique(start[members], return_inverse=True)
        even = np.full(len(states), 1.0 / len(states))
        drawn = np.vstack([np.ones(len(states)), rng.multinomial(len(states), even, resamples)])
        part = drawn[:, state]
        weights[:, members] = part / part.sum(axis=1, keepdims=True) / len(kinds)
    weights.setflags(write=False)
    return weights


def mean_success(trials: SameStarts, weights: Weights) -> Float[np.ndarray, "r c"]:
    """Mean over the objects of the share of successful trials [%]."""
    return 100.0 * weights @ trials.success.T


def mean_force(trials: SameStarts, weights: Weights) -> Float[np.ndarray, "r c"]:
    """Mean over the objects of the mean force of the trials that began to lift [N]."""
    began = np.isfinite(trials.force)
    means = []
    for k in np.unique(trials.object):
        part = trials.object == k
        total = weights[:, part] @ np.where(began, trials.force, 0.0)[:, part].T
        with np.errstate(invalid="ignore"):
            means.append(total / (weights[:, part] @ began[:, part].T))
    with np.errstate(invalid="ignore"):
        known = np.isfinite(means)
        return np.where(known, means, 0.0).sum(axis=0) / known.sum(axis=0)


def gain(trials: SameStarts, weights: Weights, first: int, second: int) -> Estimate:
    """By how much the first of two controllers lifts more often than the second [points]."""
    success = mean_success(trials, weights)
    return _estimate(success[:, first] - success[:, second])


def gain_at_equal_force(trials: SameStarts, weights: Weights, others: Sequence[int]) -> Estimate:
    """By how much the first controller lifts more often than the others at its force [points].

    The others are read as `at_equal_force` does.
    """
    success = mean_success(trials, weights)
    theirs = at_equal_force(trials, weights, others, success[:, others])
    return _estimate(success[:, 0] - theirs)


def at_equal_force(
    trials: SameStarts,
    weights: Weights,
    others: Sequence[int],
    values: Float[np.ndarray, "r k"],
) -> Float[np.ndarray, " r"]:
    """What the others have, at the force of the first controller.

    The others, one controller at several settings, are joined by straight lines that begin with
    nothing at no force and stay level beyond the largest. Those that a lighter one beats are left
    out.

    Args:
        trials: The first controller's and the others'.
        weights: See `resampled`.
        others: The settings.
        values: What is read, of each.
    """
    success, force = mean_success(trials, weights), np.nan_to_num(mean_force(trials, weights))
    order = np.argsort(force[:, others], axis=1)
    x, y, z = (
        np.pad(np.take_along_axis(part, order, axis=1), ((0, 0), (1, 0)))
        for part in (force[:, others], success[:, others], values)
    )
    kept = y >= np.maximum.accumulate(y, axis=1)
    at = zip(force[:, 0], x, z, kept, strict=True)
    return np.array([np.interp(f, u[k], v[k]) for f, u, v, k in at])


def success_within(
    trials: SameStarts,
    weights: Weights,
    controllers: Sequence[int],
    budgets: Float[np.ndarray, " b"],
) -> Float[np.ndarray, "r b"]:
    """Share of trials that are lifted with a mean force within each budget [%].

    Of one controller at several settings it is the best setting's for each budget.
    """
    within = trials.success[controllers] & (trials.force[controllers] <= budgets[:, None, None])
    return 100.0 * np.max(weights @ np.swapaxes(within, -1, -2), axis=-1).T


def success_within_by_any(
    trials: SameStarts, weights: Weights, budgets: Float[np.ndarray, " b"]
) -> Float[np.ndarray, "r b"]:
    """The same if the best of all controllers were known for each trial [%].

    Whoever chooses among these controllers does no better.
    """
    best = np.where(trials.success, trials.force, np.inf).min(axis=0)
    return 100.0 * weights @ (best <= budgets[:, None]).T


def interval(values: Float[np.ndarray, " r *b"]) -> Float[np.ndarray, " 2 *b"]:
    """Bootstrap 95 % interval of what was computed for each of the weights."""
    return np.quantile(values[1:], [0.025, 0.975], axis=0)


def gains_within(
    trials: SameStarts,
    weights: Weights,
    first: Sequence[int],
    second: Sequence[int],
    budgets: Float[np.ndarray, " b"],
) -> list[Estimate]:
    """Difference of two controllers' success within each budget [points]."""
    of = (success_within(trials, weights, which, budgets) for which in (first, second))
    one, other = of
    return [_estimate(values) for values in (one - other).T]


def _estimate(values: Float[np.ndarray, " r"]) -> Estimate:
    low, high = interval(values)
    return Estimate(float(values[0]), (float(low), float(high)))
