"""Results files: JSON of a named schema, with rows and with the run that made them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.statistics import mean_rate_interval
from mjx_grasp.handoff.dataset import KINDS
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.settings import from_record, to_record
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity
from mjx_grasp.tasks.config import RobotErrors

PROVENANCE_KEYS = ("command", "git", "versions", "device", "seed")
OUTCOMES = {"successes": "S", "never_lifted": "L", "not_held": "H", "slipped": "P"}
"""The letter of each outcome of a trial, by the row's count of it."""


@dataclass(frozen=True)
class ResultRow:
    """Outcome of one controller on one object under one condition."""

    object: str
    controller: str
    """'policy', 'squeeze' or 'grip'."""
    engine: str
    """'mujoco' or 'mjx'."""
    episodes: int
    successes: int
    never_lifted: int
    not_held: int
    slipped: int
    ci95: tuple[float, float]
    """Wilson interval of the success rate [%]."""
    force_mean_n: float | None
    """Net contact force, mean over fingers and ticks from lift onset [N]; None: no lift began."""
    force_peak_n: float | None
    """Largest force on a single finger from lift onset [N]; None: no lift began."""
    squeeze_force_n: float | None
    """Commanded force per finger [N]; None for a policy."""
    offset_mm: float
    """Lateral object offset, uniform in ± this along x and y [mm]."""
    angle_deg: float
    """Object rotation about a random axis, uniform up to this [deg]."""
    friction: float
    """Sliding friction of the object's contacts [-]."""
    handoffs: str
    """Start states of all rows together: 'ik', 'reached' or 'mixed'."""
    outcomes: str = ""
    """Trial by trial a letter of `OUTCOMES`, in the order in which the seed draws the starts; empty
    where it was not kept."""
    force_held_n: float | None = None
    """Mean force over the ticks in which the object is held off the table, of the successful trials
    [N]; None: there are none, or it was not kept. So are the fields below in older files."""
    force_peak_p50_n: float | None = None
    """Median over the trials of the largest force on a single finger [N]."""
    force_peak_p99_n: float | None = None
    """Its 99th percentile [N]."""
    forces_n: tuple[float | None, ...] = ()
    """Trial by trial the mean that `force_mean_n` is the mean of [N]; None: no lift began."""
    starts: tuple[int, ...] = ()
    """Trial by trial the number of the start state: trials that share it are not independent."""
    squeeze_split: str | None = None
    """'even' or 'balanced'; None for other controllers."""
    grip_force_n: float | None = None
    """Smallest force per finger of a grip that answers to load [N]."""
    grip_friction: float | None = None
    """Friction μ₀ that it assumes [-]."""
    mass_scale: float = 1.0
    """Factor on the object's mass [-]."""
    force_budget_n: float | None = None
    """Mean force per finger that a policy which knows a budget was allowed [N]."""
    keeping_gain: float | None = None
    """How fast the budget that it was told followed what it spared or spent too much [1/s]; 0 or
    None: it was told its own."""
    robot_errors: RobotErrors = field(default_factory=RobotErrors)
    """How the robot differed from its model."""
    label: str | None = None
    """What its policy is called, where the file has rows of another one as well."""
    friction_spread: float = 0.0
    """By which the friction differed from `friction` in a trial, uniform in ± this [-]"""
    reached_share: float | None = None
    """Share of this row's trials that began where the reaching controller came to, the others at
    postures of inverse kinematics; None in older files [-]."""

    def __post_init__(self) -> None:
        counts = {n: getattr(self, n) for n in OUTCOMES}
        if self.episodes < 1 or min(counts.values()) < 0:
            raise InputError("episodes", (self.episodes, counts), "a positive number and counts")
        if sum(counts.values()) != self.episodes:
            raise InputError(
                "episodes", self.episodes, f"the sum of its outcomes, {sum(counts.values())}"
            )
        letters = {n: self.outcomes.count(letter) for n, letter in OUTCOMES.items()}
        if self.outcomes and (letters != counts or len(self.outcomes) != self.episodes):
            raise InputError("outcomes", self.outcomes, f"as many of each as {counts}")
        low, high = self.ci95
        if not -1e-6 <= low <= self.success_percent + 1e-6 <= high + 2e-6 <= 100 + 3e-6:
            raise InputError("ci95", self.ci95, f"limits around {self.success_percent:.2f} %")
        for name in ("forces_n", "starts"):
            if len(getattr(self, name)) not in (0, self.episodes):
                raise InputError(name, len(getattr(self, name)), f"one per trial, {self.episodes}")
        if self.handoffs not in KINDS:
            raise InputError("handoffs", self.handoffs, f"one of {', '.join(KINDS)}")
        if not 0 <= (self.reached_share or 0.0) <= {"ik": 0.0}.get(self.handoffs, 1.0):
            found = f"{self.reached_share} of {self.handoffs} states"
            raise InputError("reached_share", found, "a share, 0 of ik states")
        for name in ("force_mean_n", "force_peak_n", "squeeze_force_n"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InputError(name, value, "None, or 0 N or more")
        for name in ("offset_mm", "angle_deg", "friction", "friction_spread"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(name, getattr(self, name), "a finite number, 0 or more")

    @property
    def told_alone(self) -> bool:
        """Whether its policy was told a force budget and not held to it."""
        return self.force_budget_n is not None and not self.keeping_gain

    @property
    def success_percent(self) -> float:
        """Success rate [%]."""
        return 100.0 * self.successes / self.episodes


@dataclass(frozen=True)
class ThroughputRow:
    """Speed and memory of one loop with so many worlds."""

    loop: str
    """What is timed: 'ppo' (the whole training), 'ppo_sharded' (the same over a mesh of this one
    device), 'env', 'physics', 'mujoco_warp' (no JAX)."""
    engine: str
    """'mjx' or 'mujoco'."""
    worlds: int
    objects: int
    """Objects in the scene."""
    control_steps_per_s: float
    """Control ticks of all worlds together per second [1/s]."""
    memory_gib: float | None
    """Peak of what JAX held on the device [GiB], without the CUDA context and Warp's modules; None
    where it cannot be measured."""

    def __post_init__(self) -> None:
        for name in ("worlds", "objects", "control_steps_per_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(name, value, "a positive number")


Row = TypeVar("Row", ResultRow, ThroughputRow)
SCHEMAS: dict[type, str] = {
    ResultRow: "mjx_grasp.results/1",
    ThroughputRow: "mjx_grasp.throughput/1",
}


@dataclass(frozen=True)
class Results(Generic[Row]):
    """What a results file holds."""

    rows: tuple[Row, ...]
    provenance: dict[str, Any]
    """`command`, `git`, `versions`, `device`, `seed`."""
    extra: dict[str, Any]
    """Whatever else the writer recorded."""
    robot: RobotIdentity = FIRST_ROBOT
    """Whose results these are."""


def write_results(
    path: str | Path,
    rows: Sequence[Row],
    provenance: dict[str, Any],
    robot: RobotIdentity,
    /,
    **extra: Any,
) -> None:
    """Writes rows of one kind and their provenance as JSON, complete or not at all.

    Args:
        path: The file.
        rows: At least one row; all of the same class.
        provenance: From `mjx_grasp.records.provenance.provenance`.
        robot: Whose results these are.
        **extra: Further top-level entries. `label` names the policy in tables.

    Raises:
        InputError: No rows, rows of two kinds, or an incomplete provenance.
    """
    if not rows or len({type(r) for r in rows}) != 1:
        raise InputError("rows", f"{len(rows)} rows", "one or more rows of one kind")
    missing = [k for k in PROVENANCE_KEYS if k not in provenance]
    if missing:
        raise InputError("provenance", f"no {', '.join(missing)}", ", ".join(PROVENANCE_KEYS))
    document = {
        "schema": SCHEMAS[type(rows[0])],
        "robot": to_record(robot),
        **extra,
        "rows": [asdict(r) for r in rows],
        "provenance": provenance,
    }
    write_json(path, document, strict=True)


def read_results(path: str | Path, kind: type[Row] = ResultRow) -> Results[Row]:  # type: ignore[assignment]
    """Reads a results file.

    Args:
        path: The file.
        kind: The class of its rows.

    Raises:
        FileError: It is missing, no JSON, of another schema, or has rows that contradict
            themselves.
    """
    document = read_json(path, "a results file")
    if document.get("schema") != SCHEMAS[kind]:
        raise FileError(path, f"schema {document.get('schema')!r}", f"schema {SCHEMAS[kind]!r}")
    rows, provenance = document.get("rows"), document.get("provenance")
    if not isinstance(rows, list) or not rows:
        raise FileError(path, "no rows", "a list of rows")
    if not isinstance(provenance, dict) or not set(PROVENANCE_KEYS) <= set(provenance):
        raise FileError(path, "no whole provenance", f"entries {', '.join(PROVENANCE_KEYS)}")
    try:
        robot = from_record(RobotIdentity, document.get("robot", to_record(FIRST_ROBOT)), "robot")
    except InputError as error:
        raise FileError(path, f"{error.field} = {error.found!r}", error.expected) from None
    own = ("schema", "robot", "rows", "provenance")
    extra = {k: v for k, v in document.items() if k not in own}
    found = tuple(row_from_record(path, i, r, kind) for i, r in enumerate(rows))
    return Results(found, provenance, extra, robot)


def schema_of(path: str | Path) -> str | None:
    """The schema that a JSON file names, None if it names none.

    Raises:
        FileError: The file is missing or no JSON object.
    """
    return read_json(path, "a results file").get("schema")


def mean_success(rows: Sequence[ResultRow]) -> tuple[float, tuple[float, float]]:
    """Mean of the rows' success rates, each row counting the same, and its 95 % interval [%]."""
    if not rows:
        raise InputError("rows", "none", "one row or more")
    successes, episodes = (
        np.array([getattr(r, n) for r in rows]) for n in ("successes", "episodes")
    )
    return float(np.mean(100.0 * successes / episodes)), mean_rate_interval(successes, episodes)


def row_from_record(path: str | Path, index: int, values: Any, kind: type[Row]) -> Row:
    """A row of a file, as `asdict` wrote it.

    Args:
        path: The file, for messages.
        index: Which row of it.
        values: What is there.
        kind: The row's class.

    Raises:
        FileError: It is no such row, or contradicts itself.
    """
    names = {f.name for f in fields(kind)}
    needed = {f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING}
    where = f"row {index}"
    if not isinstance(values, dict):
        raise FileError(path, f"{where}: {type(values).__name__}", "an object per row")
    for problem, keys in (("lacks", needed - set(values)), ("has unknown", set(values) - names)):
        if keys:
            raise FileError(
                path, f"{where} {problem} {', '.join(sorted(keys))}", f"rows of {SCHEMAS[kind]}"
            )
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    try:
        if "robot_errors" in values:
            values["robot_errors"] = _robot_errors(json.dumps(values["robot_errors"]))
        return kind(**values)
    except (InputError, TypeError, ValueError) as error:
        raise FileError(path, f"{where}: {error}", "a row that agrees with itself") from None


@lru_cache(maxsize=64)  # thousands of rows have the same
def _robot_errors(record: str) -> RobotErrors:
    return from_record(RobotErrors, json.loads(record), "robot_errors")
