"""What came of a training: a sentence and a small table, from controllers of the same starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_grasp.evaluation.conditions import BEGAN_WITH, Column, Groups
from mjx_grasp.evaluation.front_tables import BASELINES, Front, all_fronts, peaks_of, peaks_text
from mjx_grasp.evaluation.judging import Estimate, gain, mean_force, mean_success
from mjx_grasp.records.table import Table


class Compared(NamedTuple):
    """A policy beside something else that ran from the same starts."""

    name: str
    success: float
    """of the other [%]"""
    force: float
    """of the other; nan where no lift began [N]"""
    peaks: tuple[float, float]
    """of the other [N], see `peaks_of`"""
    gain: Estimate
    """of the policy [points]"""


class Judged(NamedTuple):
    """A policy at one setting, and what it is compared with."""

    column: Column
    success: float
    """[%]"""
    force: float
    """nan where no lift began [N]"""
    baselines: list[Compared]
    """at the same force"""
    before: Compared | None
    """the policy that it began with, asked for the same"""


def judged(front: Front) -> list[Judged]:
    """The policies among controllers, each beside the baselines and the one that it began with."""
    success = mean_success(front.trials, front.weights[:1])[0].tolist()
    force = mean_force(front.trials, front.weights[:1])[0].tolist()
    found = []
    for i, column in enumerate(front.columns):
        if column.family in BASELINES or column.family.startswith(BEGAN_WITH):
            continue
        baselines = [
            Compared(name, success[i] - more.value, force[i], front.peaks_at(i, name), more)
            for name in (front.others(column.family) if np.isfinite(force[i]) else ())
            for more in [front.against(i, name)]
        ]
        k, before = front.before(i), None
        if k is not None:
            more = gain(front.trials, front.weights, i, k)
            before = Compared(BEGAN_WITH, success[k], force[k], peaks_of(front.columns[k]), more)
        found.append(Judged(column, success[i], force[i], baselines, before))
    return found


def result_table(groups: Groups) -> Table:
    """Success, force and peak of the policies, of the baselines at their force, and before."""
    rows = []
    for condition, front in all_fronts(groups):
        for one in judged(front):
            lines = [(one.column.label, one.success, "", one.force, peaks_of(one.column))]
            lines += [
                (f"vs. {other.name}", other.success, other.gain.text(), other.force, other.peaks)
                for other in (*one.baselines, *([one.before] if one.before else []))
            ]
            rows += [
                (condition.text(), name, f"{success:.1f}", more, _force(force), peaks_text(peaks))
                for name, success, more, force, peaks in lines
            ]
    header = (
        *("condition", "controller", "lifted %", "policy − this, points"),
        *("mean force N", "peak N, median / p99"),
    )
    title = (
        "Squeezes and grips are read at the policy's force, on lines between their settings and "
        "level or down to nothing beyond them. Brackets: 95 % intervals over start states. Peak: "
        "the largest force on a finger"
    )
    return Table(title, header, tuple(rows), names=2).condensed()


def verdict(groups: Groups) -> list[str]:
    """What came of each policy, in a sentence: against what it began with, and the baselines.

    What is called more, less, raised or lowered is so beyond the 95 % interval.
    """
    said: dict[str, list[Judged]] = {}
    for condition, front in all_fronts(groups):
        for one in judged(front):
            said.setdefault(f"{condition.short()}, {one.column.family}", []).append(one)
    if len(said) == 1:
        return [_sentence(settings) for settings in said.values()]
    return [f"{name}: {_sentence(settings)}" for name, settings in said.items()]


_CHANGED = {
    1: "training raised success",
    0: "training did not change success beyond its 95 % interval",
    -1: "training lowered success",
}
_THAN = {1: "more than", 0: "no different within the 95 % interval from", -1: "less than"}


def _sentence(settings: Sequence[Judged]) -> str:
    parts = []
    for sign, changed in _CHANGED.items():
        ways = [
            _way(one, one.before)
            for one in settings
            if one.before and one.before.gain.sign() == sign
        ]
        parts += [f"{changed} ({', '.join(ways)})"] if ways else []
    equal = "an equal force of " if any(one.baselines for one in settings) else ""
    lifts = f"at {equal}{{:.1f}} N per finger the policy lifts {{:.1f}} %"
    for one in settings:
        if not np.isfinite(one.force):
            parts.append(f"{one.column.label} never begins to lift")
            continue
        part = lifts.format(one.force, one.success)
        for sign, than in _THAN.items():
            others = [
                f"a {other.name} ({other.success:.1f} %)"
                for other in one.baselines
                if other.gain.sign() == sign
            ]
            part += f", {than} {' and '.join(others)}" if others else ""
        parts.append(part)
        lifts = "at {:.1f} N it lifts {:.1f} %"
    sentence = "; ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}."


def _way(now: Judged, before: Compared) -> str:
    """Success and force before and after."""
    was, is_ = (
        f"at {force:.1f} N" if np.isfinite(force) else "without beginning to lift"
        for force in (before.force, now.force)
    )
    was = "" if was == is_ else f" % {was}"
    return f"{before.success:.1f}{was} → {now.success:.1f} % {is_}"


def _force(force: float) -> str:
    return f"{force:.1f}" if np.isfinite(force) else ""
