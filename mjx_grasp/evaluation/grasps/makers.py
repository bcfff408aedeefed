"""Runs of whole grasps that share what is dear to make: objects, worlds, controllers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from mjx_grasp.evaluation.grasps.blocks import Block, blocks_of
from mjx_grasp.evaluation.grasps.config import GraspsConfig
from mjx_grasp.evaluation.grasps.problems import Away, draw_problem, known_of
from mjx_grasp.evaluation.grasps.results import GraspRow, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all, home_tips
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.pipeline.assemble import check_graspable, known_object
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.robot.spec import RobotSpec
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene

MakeGrasper = Callable[[RobotSpec, Approach], Grasper]
"""A controller of a robot as it is mounted, whose palm is to come from somewhere."""


@dataclass
class Makers:
    """Objects, worlds and controllers, each made once, as each compiles for itself."""

    config: GraspsConfig
    robot: RobotSpec
    _graspers: dict[Any, tuple[Grasper, Library | None]] = field(default_factory=dict)
    _worlds: dict[Any, NativePhysics] = field(default_factory=dict)
    _objects: dict[Any, list[ObjectModel]] = field(default_factory=dict)
    _known: dict[Any, list[Known]] = field(default_factory=dict)

    def blocks(self) -> list[Block]:
        """All trials of a scenario, in blocks.

        Raises:
            InputError, FileError: The objects cannot be had.
        """
        config = self.config
        return blocks_of(config.episodes, len(self.objects(Scenario())), config.seed)

    def block(
        self,
        scenario: Scenario,
        make: MakeGrasper,
        block: Block,
        progress: Callable[[float], None] = lambda share: None,
    ) -> dict[str, Any]:
        """Seconds and rows of a block of a scenario, as JSON; arguments as of `run`."""
        started = time.perf_counter()
        rows = [asdict(row) for row in self.run(scenario, make, block, progress)]
        return {"seconds": round(time.perf_counter() - started, 1), "rows": rows}

    def run(
        self,
        scenario: Scenario,
        make: MakeGrasper,
        block: Block,
        progress: Callable[[float], None] = lambda share: None,
    ) -> list[GraspRow]:
        """A block of a scenario; its poses and draws are the same for every controller.

        Args:
            scenario: What happens.
            make: What makes the controller. The same one makes it once.
            block: Which trials.
            progress: Told which share of the longest possible time is done.

        Raises:
            InputError: The objects cannot be had, or not be grasped.
        """
        objects, known = self.objects(scenario), self.known(scenario)
        grasper, library = self.grasper(make, scenario)
        # As many trials where a scenario names fewer objects: the compiled functions are shared.
        trials = block.episodes * len(self.objects(Scenario())) // len(objects)
        away = Away(home_tips(grasper), scenario.away) if scenario.away else None
        problem = draw_problem(objects, trials, block.seed, away=away)
        end, trace = grasp_all(
            grasper, library, self.world(scenario, grasper.dt), known_of(known, problem), problem,
            scenario, block.seed, progress,
        )  # fmt: skip
        names = [obj.name for obj in objects]
        return grasp_rows(names, problem, end, trace, grasper.dt, scenario.hold_s)

    def grasper(self, make: MakeGrasper, scenario: Scenario) -> tuple[Grasper, Library | None]:
        """A controller for a scenario, and where its planner starts, if it has one."""
        key = make, scenario.table_height, scenario.approach
        if key not in self._graspers:
            grasper = make(self.robot.mounted(-scenario.table_height), scenario.approach)
            planner = grasper.planner
            library = None
            if planner is not None:
                library = start_library(grasper.reacher.body, planner.config)
            self._graspers[key] = grasper, library
        return self._graspers[key]

    def objects(self, scenario: Scenario) -> list[ObjectModel]:
        """The objects of a scenario.

        Raises:
            InputError, FileError: There are none such.
        """
        config, names = self.config, scenario.objects or self.config.objects
        if names not in self._objects:
            models = load_objects(names, config.objects_dir, weight=config.weight)
            self._objects[names] = list(models)
        return self._objects[names]

    def known(self, scenario: Scenario) -> list[Known]:
        """What is known of each of them.

        Raises:
            InputError: One of them cannot be grasped.
        """
        names = scenario.objects or self.config.objects
        if names not in self._known:
            objects = self.objects(scenario)
            self._known[names] = [known_object(obj, self.robot) for obj in objects]
            for obj, of in zip(objects, self._known[names], strict=True):
                check_graspable(obj.name, float(of.candidates.score.max()), self.robot.hand)
        return self._known[names]

    def world(self, scenario: Scenario, dt: float) -> NativePhysics:
        """The simulated worlds of a scenario's trials.

        Args:
            scenario: Which objects, and how high they stand.
            dt: Control period [s].
        """
        key = scenario.table_height, scenario.objects, dt
        if key not in self._worlds:
            robot = self.robot.mounted(-scenario.table_height)
            self._worlds[key] = NativePhysics(build_scene(self.objects(scenario), robot), dt)
        return self._worlds[key]
