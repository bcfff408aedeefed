"""Scenarios one after the other, from settings to a results file."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.config import ScenariosConfig
from mjx_grasp.evaluation.grasps.problems import Away, draw_problem, known_of
from mjx_grasp.evaluation.grasps.results import as_record, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all, home_tips
from mjx_grasp.evaluation.grasps.run import loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.pipeline.assemble import check_graspable, known_object
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.spec import RobotSpec, load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene

SCHEMA = "mjx_grasp.scenarios/1"
_PERCENT = 100


def run_scenarios(config: ScenariosConfig, console: Console) -> dict[str, Any]:
    """Runs what is asked for and writes the file after each scenario.

    Args:
        config: Scenarios, objects, controller, file.
        console: For progress.

    Returns:
        What the file holds.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_writable("--out", config.out)
    scenarios = load_scenarios(config.scenarios)
    file = config.policy or asset_path("policy.npz") if config.controller == "policy" else None
    makers = _Makers(config, load_robot(config.robot), file)
    made, settings = provenance(config.seed), to_record(config)
    done = _finished(config.out, settings, made, console)
    for name, scenario in scenarios.items():
        if name not in done:
            makers.objects(scenario)  # refuses before anything long starts
    with counting_progress(console) as bar:
        for name, scenario in scenarios.items():
            job = bar.add_task(name, total=_PERCENT, completed=_PERCENT if name in done else 0)
            if name in done:
                continue
            done[name] = _run(scenario, makers, config, bar, job)
            bar.update(job, completed=_PERCENT)
            write_json(
                config.out,
                {
                    "schema": SCHEMA,
                    "config": settings,
                    "scenarios": done,
                    "sha256": file_digests(policy=file),
                    "provenance": made,
                },
            )
    return {"config": settings, "scenarios": done}


@dataclass
class _Makers:
    """Controllers and worlds that scenarios share, each made once, as each compiles for itself."""

    config: ScenariosConfig
    robot: RobotSpec
    policy: Path | None
    _graspers: dict[Any, tuple[Grasper, Library]] = field(default_factory=dict)
    _worlds: dict[Any, NativePhysics] = field(default_factory=dict)
    _objects: dict[Any, list[ObjectModel]] = field(default_factory=dict)

    def grasper(self, scenario: Scenario) -> tuple[Grasper, Library]:
        key = scenario.table_height, scenario.approach
        if key not in self._graspers:
            robot = self.robot.mounted(-scenario.table_height)
            budget, approach = self.config.force_budget, scenario.approach
            grasper = loaded_grasper(robot, self.policy, budget, approach=approach)
            assert grasper.planner is not None
            library = start_library(grasper.reacher.body, grasper.planner.config)
            self._graspers[key] = grasper, library
        return self._graspers[key]

    def objects(self, scenario: Scenario) -> list[ObjectModel]:
        config, names = self.config, scenario.objects or self.config.objects
        if names not in self._objects:
            models = load_objects(names, config.objects_dir, weight=config.weight)
            self._objects[names] = list(models)
        return self._objects[names]

    def world(self, scenario: Scenario) -> NativePhysics:
        key = scenario.table_height, scenario.objects
        if key not in self._worlds:
            robot = self.robot.mounted(-scenario.table_height)
            grasper, _ = self.grasper(scenario)
            self._worlds[key] = NativePhysics(
                build_scene(self.objects(scenario), robot), grasper.dt
            )
        return self._worlds[key]


def _run(
    scenario: Scenario, makers: _Makers, config: ScenariosConfig, bar: Progress, job: Any
) -> dict[str, Any]:
    started = time.perf_counter()
    objects, (grasper, library) = makers.objects(scenario), makers.grasper(scenario)
    # As many trials where a scenario names fewer objects: the compiled functions are shared.
    trials = config.episodes * len(makers.objects(Scenario())) // len(objects)
    away = Away(home_tips(grasper), scenario.away) if scenario.away else None
    problem = draw_problem(objects, trials, config.seed, away=away)
    each = [known_object(obj, makers.robot) for obj in objects]
    for obj, of in zip(objects, each, strict=True):
        check_graspable(obj.name, float(of.candidates.score.max()), makers.robot.hand)
    known = known_of(each, problem)
    end, trace = grasp_all(
        grasper, library, makers.world(scenario), known, problem, scenario, config.seed,
        lambda share: bar.update(job, completed=round(_PERCENT * share)),
    )  # fmt: skip
    names = [obj.name for obj in objects]
    record = as_record(grasp_rows(names, problem, end, trace, grasper.dt, scenario.hold_s))
    seconds = round(time.perf_counter() - started, 1)
    return {"settings": to_record(scenario), "seconds": seconds, **record}


def _finished(
    path: Path, settings: dict[str, Any], made: dict[str, Any], console: Console
) -> dict[str, Any]:
    """Scenarios that a run with the same settings and revision has already finished."""
    if not path.exists():
        return {}
    try:
        before = json.loads(path.read_text())
        same = before["config"] == settings
        # Changes that are not committed may be others than before.
        same = same and before["provenance"]["git"] == made["git"] and "dirty" not in made["git"]
        found = before["scenarios"] if same and before["schema"] == SCHEMA else {}
    except (OSError, ValueError, KeyError, TypeError):
        raise FileError(path, "no results of scenarios", "none, or such a file") from None
    if found:
        console.print(f"{path}: goes on after {', '.join(found)}")
    return found
