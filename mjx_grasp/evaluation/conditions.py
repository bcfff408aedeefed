"""Results files by condition and controller: what tables, plots and verdicts compare."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation import judging, paper
from mjx_grasp.evaluation.results import ResultRow, Results, mean_success, read_results
from mjx_grasp.tasks.config import RobotErrors

_ENGINES = {"mujoco": "native MuJoCo", "mjx": "MJX"}
MESHES = {True: "real scans", False: "parametric stand-ins"}
"""What objects are made of, in words: whether they are scans."""
_HANDOFFS = {"ik": "IK handoffs", "reached": "reached handoffs", "mixed": "mixed handoffs"}


class Condition(NamedTuple):
    """What a table's columns have in common."""

    engine: str
    handoffs: str
    friction: float
    offset_mm: float
    angle_deg: float
    objects: frozenset[str]
    meshes: str = ""
    """What the objects are made of, in words."""
    mass_scale: float = 1.0
    robot_errors: RobotErrors = RobotErrors()
    friction_spread: float = 0.0

    def text(self) -> str:
        """The condition in words."""
        return (
            f"{_ENGINES.get(self.engine, self.engine)}, "
            f"{_HANDOFFS[self.handoffs]}, object offset ±{self.offset_mm:g} mm, "
            f"{self.angle_deg:g}°, friction {self.friction:g}{self._changes()}"
            f"{self.meshes and ', '}{self.meshes}"
        )

    def short(self) -> str:
        """Engine, start states other than those of inverse kinematics, error and friction alone."""
        turned = f", {self.angle_deg:g}°" if self.angle_deg else ""
        starts = "" if self.handoffs == "ik" else f", {_HANDOFFS[self.handoffs]}"
        return (
            f"{_ENGINES.get(self.engine, self.engine)}{starts}, ±{self.offset_mm:g} mm{turned}, "
            f"friction {self.friction:g}{self._changes()}"
        )

    def _changes(self) -> str:
        spread = f" ± {self.friction_spread:g}" if self.friction_spread else ""
        mass = "" if self.mass_scale == 1.0 else f", mass × {self.mass_scale:g}"
        return spread + mass + _errors_text(self.robot_errors)


NOT_KEPT = ", not kept"
"""Behind the name of a policy that is told its budget and not held to it."""
POLICIES = "policy", f"policy{NOT_KEPT}"
"""The families of a policy that has no name of its own."""
BEGAN_WITH = "policy that it began with"
"""The family of the policy that a training began with, beside what it made of it."""


class Column(NamedTuple):
    """One controller under a condition."""

    label: str
    rows: dict[str, ResultRow]
    draws: tuple[str, ...] = ()
    """What the trials' starts were drawn from and by; two columns that share it are paired."""
    family: str = ""
    """What columns that differ in their force alone have in common."""

    def success(self) -> float:
        """Mean success over the objects [%]."""
        return mean_success(list(self.rows.values()))[0]

    def mean(self) -> tuple[float, tuple[float, float]]:
        """Mean success over the objects and its 95 % interval [%].

        The interval draws start states anew, as trials that share one are not independent; of
        files that did not keep them it is that of independent trials.
        """
        rows = list(self.rows.values())
        if not all(row.outcomes and row.forces_n and row.starts for row in rows):
            return mean_success(rows)
        trials = judging.same_starts([rows])
        drawn = judging.mean_success(trials, judging.resampled(trials))[:, 0]
        low, high = np.percentile(drawn[1:], (2.5, 97.5))
        return float(drawn[0]), (float(low), float(high))

    def forces(self) -> tuple[float | None, float | None]:
        """Mean over the objects of the mean force, and the largest peak force [N]."""
        means = [r.force_mean_n for r in self.rows.values() if r.force_mean_n is not None]
        peaks = [r.force_peak_n for r in self.rows.values() if r.force_peak_n is not None]
        return (sum(means) / len(means) if means else None, max(peaks, default=None))


Groups = dict[Condition, list[Column]]


def read_groups(paths: Iterable[str | Path]) -> Groups:
    """Reads results files and sorts their controllers into conditions.

    Raises:
        FileError: A file cannot be read, or it repeats an outcome of another one.
    """
    groups: Groups = {}
    origin: dict[tuple[Condition, str], Path] = {}
    for path in map(Path, paths):
        results = read_results(path)
        try:
            label = str(results.extra.get("label", "policy"))
            columns = columns_of(results.rows, label, _meshes_of(results), _draws_of(results, path))
        except InputError as error:
            raise FileError(path, str(error.found), error.expected) from None
        for condition, column in columns:
            if (condition, column.label) in origin:
                raise FileError(
                    path,
                    f"{column.label!r} as in {origin[condition, column.label]}",
                    "one file per controller and condition, or another `label`",
                )
            origin[condition, column.label] = path
            groups.setdefault(condition, []).append(column)
    for group in groups.values():
        group.sort(key=column_order)
    return dict(sorted(groups.items(), key=lambda item: _condition_order(item[0])))


def _meshes_of(results: Results) -> str:
    """Scans come from a folder that the settings name, in older files the command alone."""
    if any("." in row.object for row in results.rows):  # meshes of the user
        return ""
    settings = results.extra.get("settings", {})
    if "scans" in results.extra:
        scans = bool(results.extra["scans"])
    elif "objects_dir" in settings:
        scans = settings["objects_dir"] is not None
    else:
        scans = "--objects-dir" in str(results.provenance["command"])
    return MESHES[scans]


def _draws_of(results: Results, path: Path) -> tuple[str, ...]:
    """Seed, start states and objects; of a file that does not say so, the file itself."""
    digest = results.extra.get("sha256", {}).get("handoffs")
    settings = results.extra.get("settings", {})
    if digest is None or not {"states", "objects"} <= settings.keys():
        return (str(path),)
    # The draws of an object go by its place among those that were asked for.
    return (str(results.provenance["seed"]), digest, settings["states"], *settings["objects"])


def columns_of(
    rows: Sequence[ResultRow],
    policy_label: str = "policy",
    meshes: str = "",
    draws: tuple[str, ...] = (),
) -> list[tuple[Condition, Column]]:
    """Rows by condition and controller.

    Args:
        rows: Of any conditions.
        policy_label: The family of a policy that has no name of its own.
        meshes: What the objects are made of, in words.
        draws: What the trials' starts were drawn from and by.

    Raises:
        InputError: Two rows are of one object under one condition.
    """
    parts: dict[ResultRow, dict[str, ResultRow]] = {}
    for row in rows:
        part = parts.setdefault(_without_outcome(row), {})
        if row.object in part:
            raise InputError("rows", f"two of {row.object} under one condition", "one of each")
        part[row.object] = row
    found = []
    for key, part in parts.items():
        family = (key.label or policy_label) if key.controller == "policy" else key.controller
        family += NOT_KEPT if key.told_alone else ""
        condition = Condition(
            key.engine,
            key.handoffs,
            key.friction,
            key.offset_mm,
            key.angle_deg,
            frozenset(part),
            meshes,
            key.mass_scale,
            key.robot_errors,
            key.friction_spread,
        )
        found.append((condition, Column(family + _setting(key), part, draws, family)))
    return found


def _setting(row: ResultRow) -> str:
    """What a controller was asked for, behind its name."""
    text = "" if row.squeeze_force_n is None else f" {row.squeeze_force_n:g} N"
    text += ", balanced" if row.squeeze_split == "balanced" else ""
    text += "" if row.grip_force_n is None else f" {row.grip_force_n:g} N"
    text += "" if row.grip_friction is None else f", μ₀ {row.grip_friction:g}"
    return text + ("" if row.force_budget_n is None else f", budget {row.force_budget_n:g} N")


def _errors_text(errors: RobotErrors) -> str:
    """What is wrong with a robot, behind a condition."""
    text = f", torque ± {errors.torque_std:g} N m" if errors.torque_std else ""
    text += f" in steps of {errors.torque_step:g}" if errors.torque_step else ""
    text += f", joint friction ± {100 * errors.friction:g} %" if errors.friction else ""
    ranges = (("gains ×", errors.stiffness, 1.0), ("latency", errors.latency_s, 0.0))
    for name, (low, high), ideal in ranges:
        text += f", {name} {low:g}–{high:g}" if (low, high) != (ideal, ideal) else ""
    return text


def _without_outcome(row: ResultRow) -> ResultRow:
    """The row's controller and condition alone, as a key."""
    return replace(
        row, object="", episodes=1, successes=1, never_lifted=0, not_held=0, slipped=0,
        ci95=(0.0, 100.0), force_mean_n=None, force_peak_n=None, outcomes="",
        force_held_n=None, force_peak_p50_n=None, force_peak_p99_n=None, forces_n=(), starts=(),
        reached_share=None,
    )  # fmt: skip


def column_order(column: Column) -> tuple[bool, float, float, float, bool, str]:
    """What columns are sorted by: squeezes last, then keeping, budget and name."""
    row = next(iter(column.rows.values()))
    force = row.squeeze_force_n
    another = row.label is not None
    kept, budget = row.keeping_gain or 0.0, row.force_budget_n or 0.0
    return (force is not None, force or 0.0, kept, budget, another, column.label)


def _condition_order(c: Condition) -> tuple:
    """The publication's eight objects first, native MuJoCo before MJX, small errors first."""
    return (
        c.objects != paper.OBJECTS.keys(),
        sorted(c.objects),
        c.engine != "mujoco",
        c.handoffs != "reached",
        -c.friction,
        c.offset_mm,
        c.angle_deg,
        c.meshes,
        c.mass_scale,
        str(c.robot_errors),
        c.friction_spread,
    )
