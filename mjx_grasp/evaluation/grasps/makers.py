"""Runs of whole grasps that share what is dear to make: objects, worlds, controllers."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import numpy as np

from mjx_grasp.evaluation.grasps.blocks import Block, Part, blocks_of, parts_of
from mjx_grasp.evaluation.grasps.config import GraspsConfig
from mjx_grasp.evaluation.grasps.problems import Away, draw_problem
from mjx_grasp.evaluation.grasps.results import GraspRow, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.evaluation.grasps.trials import GraspProblem, home_tips
from mjx_grasp.objects.catalogue import find_objects
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.known import check_graspable, known_objects
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.sim.engines import make_physics
from mjx_grasp.sim.physics import Physics
from mjx_grasp.sim.scene import Scene, build_scene

MakeGrasper = Callable[[RobotSpec, Approach], Grasper]
"""A controller of a robot as it is mounted, whose palm is to come from somewhere."""


_WORLDS = 2048
"""Trials under way at once in MJX: with more a tick takes as much longer."""

Case = TypeVar("Case")


def compiled_for(scenario: Scenario) -> Hashable:
    """What of a scenario decides which functions a controller compiles for it, and which worlds."""
    return (
        scenario.table_height,
        scenario.approach,
        len(scenario.obstacles),
        scenario.objects,
    )


@dataclass
class Makers:
    """Objects, worlds and controllers, each made once, as each compiles for itself."""

    config: GraspsConfig
    robot: RobotSpec
    _graspers: dict[Any, Grasper] = field(default_factory=dict)
    _libraries: dict[Any, Library | None] = field(default_factory=dict)
    _scenes: dict[Any, Scene] = field(default_factory=dict)
    _worlds: dict[Any, Physics] = field(default_factory=dict)
    _objects: dict[Any, list[ObjectModel]] = field(default_factory=dict)
    _known: dict[Any, list[Known]] = field(default_factory=dict)

    def parts(self) -> list[Part]:
        """All trials of a scenario, in parts that are run at once.

        Raises:
            InputError, FileError: The objects cannot be had.
        """
        config, objects = self.config, len(self.objects(Scenario()))
        return parts_of(blocks_of(config.episodes, objects, config.seed), objects, config.engine)

    def batches(self, cases: Sequence[Case], kind: Callable[[Case], Hashable]) -> list[list[Case]]:
        """What is run together: in MJX all of a kind; else each alone.

        Args:
            cases: Scenarios, or what else has trials.
            kind: What those have in common that can share a batch, see `compiled_for`.
        """
        if self.config.engine != "mjx":
            return [[case] for case in cases]
        by: dict[Hashable, list[Case]] = {}
        for case in cases:
            by.setdefault(kind(case), []).append(case)
        return list(by.values())

    def check(self, scenario: Scenario, make: MakeGrasper, parts: Sequence[Part]) -> None:
        """Refuses a scenario before anything long starts; arguments as of `run`.

        Raises:
            InputError, FileError: Its objects, its controller or its poses cannot be had.
        """
        self.grasper(make, scenario)
        self.known(scenario)
        for part in parts:
            self.problem(scenario, make, part)

    def part(
        self,
        scenarios: Sequence[Scenario],
        make: MakeGrasper,
        part: Part,
        progress: Callable[[float], None] = lambda share: None,
    ) -> list[dict[str, Any]]:
        """Seconds and rows of a part of each scenario, as JSON; arguments as of `run`."""
        started, count = time.perf_counter(), len(scenarios)
        rows = self.run(scenarios, make, part, progress)
        seconds = round((time.perf_counter() - started) / count, 1)
        return [{"seconds": seconds, "rows": [asdict(row) for row in own]} for own in rows]

    def run(
        self,
        scenarios: Sequence[Scenario],
        make: MakeGrasper,
        part: Part,
        progress: Callable[[float], None] = lambda share: None,
    ) -> list[list[GraspRow]]:
        """A part of some scenarios, in one batch; rows of each.

        Poses and headings are the same for every controller.

        Args:
            scenarios: What happens in each, all of a kind (`compiled_for`).
            make: What makes the controller. The same one makes it once.
            part: Which trials.
            progress: Told which share of the longest possible time is done.

        Raises:
            InputError: The objects cannot be had, not be grasped, or not lie where they are to.
        """
        like = scenarios[0]
        problems = [self.problem(scenario, make, part) for scenario in scenarios]
        problem = GraspProblem(*map(np.concatenate, zip(*problems, strict=True)))
        grasper, library = self.grasper(make, like), self.library(make, like)
        count = len(problem.object_index)
        worlds = min(count, _WORLDS) if self.config.engine == "mjx" else count
        physics, known = self.physics(like, worlds, grasper.dt), self.known(like)
        end, trace = grasp_all(
            grasper, library, physics, known, problem, scenarios, worlds, progress=progress
        )
        names = [obj.name for obj in self.objects(like)]
        rows = grasp_rows(names, problem, end, trace, grasper.dt)
        trials = len(rows) // len(scenarios)
        return [rows[k : k + trials] for k in range(0, len(rows), trials)]

    def problem(self, scenario: Scenario, make: MakeGrasper, part: Part) -> GraspProblem:
        """The poses of a part of a scenario; arguments as of `run`.

        Raises:
            InputError: The objects cannot be had, or not lie as far away as they are to.
        """
        scene = self.scene(scenario)
        away = None
        if scenario.away:
            away = Away(home_tips(self.grasper(make, scenario)), scenario.away)

        def of(block: Block) -> GraspProblem:
            # As many trials where a scenario names its own: the compiled functions are shared.
            trials = max(1, block.episodes * len(self.objects(Scenario())) // len(scene.objects))
            return draw_problem(scene, trials, block.seed, away=away)

        return GraspProblem(*map(np.concatenate, zip(*map(of, part), strict=True)))

    def grasper(self, make: MakeGrasper, scenario: Scenario) -> Grasper:
        """A controller for a scenario."""
        key = make, scenario.table_height, scenario.approach
        if key not in self._graspers:
            robot = self.robot.mounted(-scenario.table_height)
            self._graspers[key] = make(robot, scenario.approach)
        return self._graspers[key]

    def library(self, make: MakeGrasper, scenario: Scenario) -> Library | None:
        """Where that controller's planner starts; None without one."""
        key = make, scenario.table_height, scenario.approach
        if key not in self._libraries:
            grasper = self.grasper(make, scenario)
            planner, body = grasper.planner, grasper.reacher.body
            found = None if planner is None else start_library(body, planner.config)
            self._libraries[key] = found
        return self._libraries[key]

    def objects(self, scenario: Scenario) -> list[ObjectModel]:
        """The objects of a scenario.

        Raises:
            InputError, FileError: There are none such.
        """
        config, own = self.config, scenario.objects
        if own not in self._objects:
            # The user's weight is of meshes: a scenario that names none does not ask for it.
            weighed = not own or any(each.file is not None for each in find_objects(own))
            weight = config.weight if weighed else None
            models = load_objects(own or config.objects, config.objects_dir, weight=weight)
            self._objects[own] = list(models)
        return self._objects[own]

    def known(self, scenario: Scenario) -> list[Known]:
        """What is known of each of them.

        Raises:
            InputError: One of them cannot be grasped.
        """
        if scenario.objects not in self._known:
            objects = self.objects(scenario)
            found = known_objects(objects, self.robot)
            for obj, known in zip(objects, found, strict=True):
                best = float(known.candidates.score.max())
                check_graspable(obj.name, best, self.robot.hand)
            self._known[scenario.objects] = found
        return self._known[scenario.objects]

    def scene(self, scenario: Scenario) -> Scene:
        """Robot and objects of a scenario, as high as these stand.

        Raises:
            InputError, FileError: The objects cannot be had.
        """
        key = scenario.table_height, scenario.objects
        if key not in self._scenes:
            robot = self.robot.mounted(-scenario.table_height)
            self._scenes[key] = build_scene(self.objects(scenario), robot)
        return self._scenes[key]

    def physics(self, scenario: Scenario, worlds: int, dt: float) -> Physics:
        """What steps the worlds of some trials of a scenario.

        Args:
            scenario: Which objects, and how high they stand.
            worlds: How many.
            dt: Control period [s].
        """
        engine = self.config.engine
        key = scenario.table_height, scenario.objects, worlds if engine == "mjx" else None, dt
        if key not in self._worlds:
            self._worlds[key] = make_physics(engine, self.scene(scenario), worlds, dt)
        return self._worlds[key]
