"""Policy, squeezes and grip from the same starts: what the scripts that compare them share.

Results keep one entry per controller. A file of the same settings, inputs and revision of the code
is gone on with, unless there are uncommitted changes: an interrupted run loses only what it was at.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.run import outcome_letters
from mjx_grasp.evaluation.trials import (
    Controller,
    Trials,
    by_object,
    force_apart,
    joined_draws,
    paired_draws,
    run_trials,
    zero_controller,
)
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, with_states
from mjx_grasp.learning.controller import deployed_task, load_controller, policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.objects.catalogue import find_objects
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.records.atomic import check_replaceable, read_json, write_json
from mjx_grasp.records.journal import Journal, goes_on
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Count, Positive, Seed, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.engines import Engine
from mjx_grasp.sim.scene import SceneConfig, build_scene
from mjx_grasp.tasks.assemble import TaskConfig, build_world
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.tasks.task import Task


@dataclass(frozen=True)
class ComparedConfig(Spread):
    """Which controllers, from which starts."""

    out: Path
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    budgets: tuple[Positive, ...] = (3.0, 8.0)
    """force budgets of the policy [N]"""
    squeezes: tuple[Positive, ...] = (3.0, 5.0)
    """forces of the squeeze [N]"""
    engine: Engine = "mujoco"
    """what steps the physics: mujoco (native, in threads) or mjx (Warp, on a GPU)"""
    episodes: Count = 16
    """of each object under each condition [-]"""
    seed: Seed = 0
    known: Path | None = None
    """results of another policy, whose squeezes and grip are taken as they are"""


Condition = tuple[Mapping[str, Any], StartNoise]
"""What its rows say of it, and what is drawn under it."""


class Contestant(NamedTuple):
    """A controller that is compared."""

    task: TaskConfig
    act: Controller | None
    """None: the task's own command alone"""
    force: float
    """budget of the policy, or what a grip commands [N]"""


def compiled_for(who: Contestant) -> Hashable:
    """What those have in common that share compiled functions in one scene."""
    return force_apart(who.task)[0], who.act is None


class Comparison(NamedTuple):
    """What there is to compare, and what of it is done."""

    record: dict[str, Any]
    """the results file"""
    contestants: dict[str, Contestant]
    names: list[str]
    """objects with start states"""
    objects: list[ObjectModel]
    robot: RobotSpec
    states: HandoffSet


def compared(config: ComparedConfig, schema: str, what: str) -> Comparison:
    """Loads everything, and what an earlier run of the same settings has left.

    Args:
        config: The script's settings.
        schema: Of its results.
        what: They are called in messages.

    Raises:
        InputError: No object has start states, or the file cannot be written or is another one.
        FileError: A file is missing or damaged.
    """
    check_replaceable("--out", config.out, [schema])
    made, robot = provenance(config.seed), load_robot()
    policy_file = config.policy or asset_path("policy.npz")
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    policy, stored = load_comparable(policy_file, robot), load_handoffs(handoffs, robot=robot)
    identity = {
        "schema": schema,
        "settings": to_record(unspread(config)),
        "sha256": file_digests(policy=policy_file, handoffs=handoffs),
    }
    record: dict[str, Any] = identity | {"controllers": {}, "provenance": made}
    if config.out.exists():
        before = read_json(config.out, what)
        if goes_on(before, identity, made["git"]):
            record = before
    asked = [each.name for each in find_objects(config.objects)]
    names, _, states = with_states(asked, stored, "evaluation")
    if not names:
        raise InputError("--objects", config.objects, f"some of {', '.join(stored.object_names)}")

    contestants = contestants_of(policy, config.budgets, config.squeezes)
    contestants |= {"grip": _gripping(REACTING)}
    if config.known is not None and not record["controllers"]:
        alone = [name for name, who in contestants.items() if who.act is None]
        take_known(record, config.known, alone, what)
    objects = load_objects(config.objects, config.objects_dir)
    return Comparison(record, contestants, names, objects, robot, states)


def load_comparable(path: Path, robot: RobotSpec) -> Policy:
    """Reads a policy that can stand beside a squeeze, in worlds that go on as long a tick as both.

    Raises:
        FileError: It is unreadable, of another robot or task, or has another control period.
    """
    policy = load_controller(path, robot)
    its, ours = policy_task(policy).control_dt, TaskConfig().control_dt
    if its != ours:
        expected = f"{1e3 * ours:g} ms, that of squeeze and grip"
        raise FileError(path, f"a control period of {1e3 * its:g} ms", expected)
    return policy


def contestants_of(
    policy: Policy, budgets: Sequence[float], squeezes: Sequence[float]
) -> dict[str, Contestant]:
    """A policy under budgets and squeezes of forces, by what they are called.

    Args:
        policy: The policy.
        budgets: Of force [N].
        squeezes: Forces [N].
    """
    act, trained = policy.controller(), deployed_task(policy)
    return {f"policy, budget {b:g} N": Contestant(trained, act, b) for b in budgets} | {
        f"squeeze {f:g} N": _gripping(GripConfig(force=f)) for f in squeezes
    }


def _gripping(grip: GripConfig) -> Contestant:
    return Contestant(replace(TaskConfig(), grip=grip), None, grip.force)


def take_known(record: dict[str, Any], path: Path, names: Sequence[str], what: str) -> None:
    """Puts what an earlier file has of controllers without a policy into a record, with its origin.

    Args:
        record: A results file that has nothing yet.
        path: The earlier file.
        names: The controllers.
        what: Such files are called in messages.

    Raises:
        FileError: There is no such file, or it is of other trials.
    """
    earlier = read_json(path, what)
    settings = {"engine": "mujoco"} | earlier.get("settings", {})  # once there was no other
    # The states are compared by what is in them.
    own = {"out", "policy", "budgets", "squeezes", "known", "handoffs", "objects_dir"}
    states = (earlier.get("sha256", {}).get("handoffs"), record["sha256"]["handoffs"])
    same = {"schema": (earlier.get("schema"), record["schema"]), "states (sha256)": states}
    same |= {
        name: (settings.get(name), value)
        for name, value in record["settings"].items()
        if name not in own
    }
    for name, (found, expected) in same.items():
        if found != expected:
            raise FileError(path, f"{name} {found!r}", f"{expected!r}")
    rows = earlier["controllers"]
    record["controllers"] |= {name: rows[name] for name in names if name in rows}
    more = {"known": earlier["known"]} if "known" in earlier else {}
    record["known"] = [earlier["provenance"] | more]


def keep(config: ComparedConfig, found: Comparison) -> None:
    """Writes what is done, the controllers in their own order."""
    done = found.record["controllers"]
    kept = {name: done[name] for name in found.contestants if name in done}
    write_json(config.out, found.record | {"controllers": kept})


def journal_of(config: ComparedConfig, found: Comparison) -> Journal:
    """Where finished conditions are until their turn in the file comes."""
    same = ("schema", "settings", "sha256")
    identity = {name: found.record[name] for name in same}
    return Journal(config.out, identity, found.record["provenance"]["git"])


class Runner:
    """Trials of the controllers of a comparison in one scene.

    Args:
        found: The comparison.
        episodes: Trials of each object.
        seed: Of their starts.
        engine: What steps the physics.
        physics: Of the scene.
        angle_rad: How far any of the trials turns the object: tasks that turn none differ.
        beside: Conditions that have room in a batch, which is of one size.
    """

    def __init__(
        self,
        found: Comparison,
        episodes: int,
        seed: int,
        engine: Engine = "mujoco",
        physics: SceneConfig | None = None,
        angle_rad: float = 0.0,
        beside: int = 1,
    ):
        scene = build_scene(found.objects, found.robot, physics or SceneConfig())
        self._world = build_world(scene, found.states, TaskConfig().control_dt)
        self._found, self._episodes, self._seed, self._engine = found, episodes, seed, engine
        self._widest = StartNoise(angle_rad=angle_rad)
        self._worlds = episodes * len(found.names) * beside
        self._tasks: dict[TaskConfig, Task] = {}

    def rows(self, name: str, conditions: Sequence[Condition]) -> list[list[dict[str, Any]]]:
        """Trials of a controller under some conditions beside each other.

        Args:
            name: The controller.
            conditions: Which; from the seed all have the same draws.

        Returns:
            Of each condition a row per object.
        """
        who, names, starts = self._found.contestants[name], self._found.names, self._world.starts
        config, force = force_apart(who.task)
        if config not in self._tasks:
            made = self._world.task(self._engine, self._worlds, config, self._widest, False)
            self._tasks[config] = made
        task = self._tasks[config]
        index = [self._world.scene.object_index(of) for of in names]
        draws = []
        for _, noise in conditions:
            noise = replace(noise, budget_n=(who.force, who.force))
            draws.append(paired_draws(starts, index, self._episodes, noise, self._seed, force))
        act = who.act or zero_controller(task)
        trials = run_trials(task, act, joined_draws(draws), self._worlds)
        each = by_object(trials, len(conditions))
        return [rows_of(own, at, names) for (at, _), own in zip(conditions, each, strict=True)]


def rows_of(trials: Trials, at: Mapping[str, Any], names: Sequence[str]) -> list[dict[str, Any]]:
    """One row per object, of trials in that order under one condition."""
    return [
        {
            **at,
            "object": name,
            "outcomes": "".join(outcome_letters(own)),
            "starts": own.row.tolist(),
            "forces_n": _rounded(np.asarray(own.force_mean)),
        }
        for name, own in zip(names, by_object(trials, len(names)), strict=True)
    ]


def _rounded(forces: Float[np.ndarray, " n"]) -> list[float | None]:
    return [None if np.isnan(x) else round(float(x), 3) for x in forces]
