"""Who lifts more with the same force: tables of controllers from the same starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_grasp.evaluation.conditions import BEGAN_WITH, POLICIES, Column, Condition, Groups
from mjx_grasp.evaluation.judging import (
    Estimate,
    SameStarts,
    Weights,
    at_equal_force,
    gain_at_equal_force,
    gains_within,
    mean_force,
    mean_success,
    resampled,
    same_starts,
    success_within,
    success_within_by_any,
)
from mjx_grasp.records.table import Table

BUDGETS_N = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
_OBJECT_BUDGETS_N = (3.0, 4.0)
BASELINES = ("squeeze", "grip")


class Front(NamedTuple):
    """Controllers that ran from the same starts, by the family that differs in its force alone."""

    families: dict[str, list[int]]
    columns: list[Column]
    trials: SameStarts
    weights: Weights

    def against(self, one: int, family: str) -> Estimate:
        """Gain of one controller over a family at equal force [points]."""
        trials, others = self._beside(one, family)
        return gain_at_equal_force(trials, self.weights, others)

    def peaks_at(self, one: int, family: str) -> tuple[float, float]:
        """A family's peaks, as `peaks_of` has them, at the force of one controller [N]."""
        trials, others = self._beside(one, family)
        peaks = zip(*(peaks_of(self.columns[i]) for i in self.families[family]), strict=True)
        median, high = (
            at_equal_force(trials, self.weights[:1], others, np.array([part])) for part in peaks
        )
        return float(median[0]), float(high[0])

    def before(self, one: int) -> int | None:
        """What a trained policy is compared with: the one it began with, asked for the same."""
        column = self.columns[one]
        asked = column.label.removeprefix(column.family)
        labels = [other.label for other in self.columns]
        return labels.index(BEGAN_WITH + asked) if BEGAN_WITH + asked in labels else None

    def _beside(self, one: int, family: str) -> tuple[SameStarts, Sequence[int]]:
        """Trials of one controller, then of a family; and which these are."""
        order = [one, *self.families[family]]
        success, force = self.trials.success[order], self.trials.force[order]
        return self.trials._replace(success=success, force=force), range(1, len(order))

    def within(self, family: str, budgets: Sequence[float]) -> Float[np.ndarray, "r b"]:
        """Success of a family within budgets, as it was and with the starts drawn anew [%]."""
        asked = np.asarray(budgets, float)
        return success_within(self.trials, self.weights, self.families[family], asked)

    def gains(self, first: str, second: str, budgets: Sequence[float]) -> list[Estimate]:
        """Difference of two families' success within budgets [points]."""
        which = self.families[first], self.families[second]
        return gains_within(self.trials, self.weights, *which, np.asarray(budgets, float))

    def others(self, family: str) -> list[str]:
        """The baselines beside a family."""
        return [name for name in BASELINES if name in self.families and name != family]


def fronts(columns: Sequence[Column]) -> list[Front]:
    """Sorts controllers of one condition by the starts that they share.

    Those whose trials were not kept with forces and starts are left out, and those that share their
    starts with no other.
    """
    by_draws: dict[tuple, list[Column]] = {}
    for column in columns:
        rows = sorted(column.rows.values(), key=lambda row: row.object)
        if all(row.forces_n and row.starts for row in rows):
            starts = (*column.draws, *(row.starts for row in rows))
            by_draws.setdefault(starts, []).append(column)
    found = []
    for group in by_draws.values():
        families: dict[str, list[int]] = {}
        for i, column in enumerate(group):
            families.setdefault(column.family, []).append(i)
        if len(families) > 1:
            trials = same_starts([tuple(column.rows.values()) for column in group])
            found.append(Front(families, group, trials, resampled(trials)))
    return found


def front_panels(groups: Groups) -> dict[str, Front]:
    """The controllers that can be compared, by the condition's words; the first set of each."""
    panels: dict[str, Front] = {}
    for condition, front in all_fronts(groups):
        panels.setdefault(condition.short(), front)
    return panels


def equal_force_table(groups: Groups) -> Table:
    """Policies and grips against the baselines' fronts at the force that they took themselves.

    The fronts are joined by straight lines, from no success at no force on, and stay level beyond
    the hardest setting; the intervals draw the start states anew. No gain on a baseline is larger
    than the share of trials in which that fails.
    """
    rows = []
    for condition, front in all_fronts(groups):
        success = mean_success(front.trials, front.weights[:1])[0]
        force = mean_force(front.trials, front.weights[:1])[0]
        for i in (i for name, part in front.families.items() if name != "squeeze" for i in part):
            column = front.columns[i]
            gains = []
            for name in BASELINES:
                if name in front.families and name != column.family:
                    gain = front.against(i, name)
                    gains += [gain.text(), f"{max(0.0, gain.value + 100.0 - success[i]):.1f}"]
                else:
                    gains += ["", ""]
            rows.append(
                (
                    condition.short(),
                    column.label,
                    f"{success[i]:.1f}",
                    f"{force[i]:.1f}",
                    *gains,
                    peaks_text(peaks_of(column)),
                )
            )
    header = (
        *("condition", "controller", "success %", "force N"),
        *(cell for name in BASELINES for cell in (f"− {name} at this force", "most possible")),
        "peak N, median / 99th percentile",
    )
    return Table("At equal force, points", header, tuple(rows), names=2)


def budget_table(groups: Groups) -> Table:
    """Share of trials that are lifted within a mean force per finger, and differences of it.

    Of a controller with several settings it is the best setting's for each budget. The last of each
    condition would be theirs if the best of all was known for each trial.
    """
    rows = []
    asked = np.asarray(BUDGETS_N)
    for condition, front in all_fronts(groups):
        shares = {name: front.within(name, BUDGETS_N)[0] for name in front.families}
        shares["best of each trial"] = success_within_by_any(
            front.trials, front.weights[:1], asked
        )[0]
        for name, values in shares.items():
            rows.append((condition.short(), name, *(f"{value:.1f}" for value in values)))
        for name in front.families:
            for other in front.others(name) if name != "squeeze" else ():
                gains = (gain.text() for gain in front.gains(name, other, BUDGETS_N))
                rows.append((condition.short(), f"{name} − {other}", *gains))
    header = ("condition", "controller", *(f"{budget:g} N" for budget in BUDGETS_N))
    return Table("Lifted within a mean force per finger, %", header, tuple(rows), names=2)


def object_budget_table(groups: Groups) -> Table:
    """The same object by object, of policies: which of them ask for more than the budget.

    Of a policy with several settings it is the best setting's for each object and budget.
    """
    rows = []
    asked = np.asarray(_OBJECT_BUDGETS_N)
    for condition, front in all_fronts(groups):
        names, of = sorted(front.columns[0].rows), front.trials.object
        policies = [i for name in POLICIES for i in front.families.get(name, ())]
        if not policies or len(names) == 1:
            continue
        for k, name in enumerate(names):
            weights = ((of == k) / np.sum(of == k))[None]
            best = success_within(front.trials, weights, policies, asked)[0]
            any_ = success_within_by_any(front.trials, weights, asked)[0]
            shares = (f"{x:.1f}" for pair in zip(best, any_, strict=True) for x in pair)
            rows.append((condition.short(), name.replace("_", " "), *shares))
    header = ["condition", "object"]
    for budget in _OBJECT_BUDGETS_N:
        header += [f"{budget:g} N: policy", f"{budget:g} N: best of each trial"]
    title = "Lifted within a budget, object by object, %"
    return Table(title, tuple(header), tuple(rows), names=2)


def all_fronts(groups: Groups) -> Iterator[tuple[Condition, Front]]:
    """The controllers that can be compared, condition by condition."""
    for condition, columns in groups.items():
        for front in fronts(columns):
            yield condition, front


def peaks_of(column: Column) -> tuple[float, float]:
    """Mean over the objects of the median, and of the 99th percentile, of the peak force [N]."""
    peaks = [
        (row.force_peak_p50_n, row.force_peak_p99_n)
        for row in column.rows.values()
        if row.force_peak_p50_n is not None and row.force_peak_p99_n is not None
    ]
    median, high = np.mean(peaks, axis=0) if peaks else (np.nan, np.nan)
    return float(median), float(high)


def peaks_text(peaks: tuple[float, float]) -> str:
    """Such peaks as a cell; empty where they were not kept."""
    return "{:.1f} / {:.0f}".format(*peaks) if np.isfinite(peaks).all() else ""
