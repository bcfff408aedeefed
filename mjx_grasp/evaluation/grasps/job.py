"""Scenarios one after the other, from settings to a results file."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.blocks import Begun, Block, BlockResult
from mjx_grasp.evaluation.grasps.config import ScenariosConfig
from mjx_grasp.evaluation.grasps.makers import Makers
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.evaluation.spread import as_done, unspread
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.spec import RobotSpec, load_robot

SCHEMA = "mjx_grasp.scenarios/1"
_PERCENT = 100


class _Grasps:
    """What every process that runs scenarios needs.

    Args:
        config: Objects, controller.
        progress: Told which share of the scenario under way is done.
    """

    def __init__(
        self, config: ScenariosConfig, progress: Callable[[float], None] = lambda share: None
    ):
        robot = load_robot(config.robot)
        self.file = closing_policy(config.controller, config.policy, robot)
        self.makers = Makers(config, robot)
        self._config, self._progress = config, progress

    def run(self, job: tuple[Scenario, Block]) -> BlockResult:
        """What came of a block of a scenario."""
        scenario, block = job
        started = time.perf_counter()
        rows = self.makers.run(scenario, self._make, block, self._progress)
        return BlockResult(rows, time.perf_counter() - started)

    def _make(self, robot: RobotSpec, approach: Approach) -> Grasper:
        return loaded_grasper(robot, self.file, self._config.force_budget, approach=approach)


def run_scenarios(config: ScenariosConfig, console: Console) -> dict[str, Any]:
    """Runs what is asked for and writes the file after each block of trials.

    Args:
        config: Scenarios, objects, controller, file, and who shares the blocks.
        console: For progress.

    Returns:
        What the file holds.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_writable("--out", config.out)
    scenarios = load_scenarios(config.scenarios)
    made, settings = provenance(config.seed), to_record(unspread(config))
    done, begun = _before(config.out, settings, made, console)
    with counting_progress(console) as bar:
        own = _Grasps(
            config,
            lambda share: bar.update(
                bars[left[0][0]], completed=progress_of(left[0][0]) + _PERCENT * share
            ),  # alone it is at the first of those that are left
        )
        for name in scenarios:
            own.makers.objects(scenarios[name])  # refuses before anything long starts
        blocks = own.makers.blocks()
        about = {name: {"settings": to_record(scenario)} for name, scenario in scenarios.items()}
        left = [
            (name, block)
            for name in scenarios
            if name not in done
            for block in begun.left(name, about[name], blocks)
        ]

        def progress_of(name: str) -> int:
            waiting = sum(name == other for other, _ in left)
            return _PERCENT * (len(blocks) - waiting)

        bars = {
            name: bar.add_task(name, total=_PERCENT * len(blocks), completed=progress_of(name))
            for name in scenarios
        }
        setup = (lambda: own) if config.alone else partial(_Grasps, config)
        asked = tuple(left)
        jobs = [(scenarios[name], block) for name, block in asked]
        for k, found in as_done(config, _Grasps.run, jobs, setup):
            name, block = asked[k]
            left.remove(asked[k])
            if whole := begun.add(name, about[name], blocks, block, found):
                done[name] = whole
            bar.update(bars[name], completed=progress_of(name))
            ordered = {name: done[name] for name in scenarios if name in done}
            content: dict[str, Any] = {"schema": SCHEMA, "config": settings, "scenarios": ordered}
            content |= {"begun": begun.record} if begun.record else {}
            content |= {"sha256": file_digests(policy=own.file), "provenance": made}
            write_json(config.out, content)
    return {"config": settings, "scenarios": {name: done[name] for name in scenarios}}


def _before(
    path: Path, settings: dict[str, Any], made: dict[str, Any], console: Console
) -> tuple[dict[str, Any], Begun]:
    """What a run with the same settings and revision has finished, and what it has begun."""
    if not path.exists():
        return {}, Begun()
    try:
        before = json.loads(path.read_text())
        same = before["config"] == settings
        # Changes that are not committed may be others than before.
        same = same and before["provenance"]["git"] == made["git"] and "dirty" not in made["git"]
        same = same and before["schema"] == SCHEMA
        found, begun = before["scenarios"], before.get("begun", {})
    except (OSError, ValueError, KeyError, TypeError):
        raise FileError(path, "no results of scenarios", "none, or such a file") from None
    if not same:
        return {}, Begun()
    if found or begun:
        console.print(f"{path}: goes on after {', '.join([*found, *begun])}")
    return found, Begun(begun)
