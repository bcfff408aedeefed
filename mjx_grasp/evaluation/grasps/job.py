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
from mjx_grasp.evaluation.grasps.config import ScenariosConfig
from mjx_grasp.evaluation.grasps.makers import Makers
from mjx_grasp.evaluation.grasps.results import as_record
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.evaluation.spread import spread, unspread
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

    def run(self, scenario: Scenario) -> dict[str, Any]:
        """What came of a scenario."""
        started = time.perf_counter()
        rows = self.makers.run(scenario, self._make, self._progress)
        seconds = round(time.perf_counter() - started, 1)
        return {"settings": to_record(scenario), "seconds": seconds, **as_record(rows)}

    def _make(self, robot: RobotSpec, approach: Approach) -> Grasper:
        return loaded_grasper(robot, self.file, self._config.force_budget, approach=approach)


def run_scenarios(config: ScenariosConfig, console: Console) -> dict[str, Any]:
    """Runs what is asked for and writes the file after each scenario.

    Args:
        config: Scenarios, objects, controller, file, and who shares the scenarios.
        console: For progress.

    Returns:
        What the file holds.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_writable("--out", config.out)
    scenarios = load_scenarios(config.scenarios)
    made, settings = provenance(config.seed), to_record(unspread(config))
    done = _finished(config.out, settings, made, console)
    waiting = [name for name in scenarios if name not in done]
    with counting_progress(console) as bar:
        own = _Grasps(
            config, lambda share: bar.update(jobs[waiting[0]], completed=round(_PERCENT * share))
        )
        for name in waiting:
            own.makers.objects(scenarios[name])  # refuses before anything long starts
        jobs = {
            name: bar.add_task(name, total=_PERCENT, completed=_PERCENT if name in done else 0)
            for name in scenarios
        }
        setup = (lambda: own) if config.alone else partial(_Grasps, config)
        for found in spread(config, _Grasps.run, [scenarios[n] for n in waiting], setup):
            name = waiting.pop(0)
            done[name] = found
            bar.update(jobs[name], completed=_PERCENT)
            content: dict[str, Any] = {"schema": SCHEMA, "config": settings, "scenarios": done}
            content |= {"sha256": file_digests(policy=own.file), "provenance": made}
            write_json(config.out, content)
    return {"config": settings, "scenarios": done}


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
