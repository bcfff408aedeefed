"""Scenarios one after the other, from settings to a results file."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.config import ScenariosConfig
from mjx_grasp.evaluation.grasps.makers import MakeGrasper, Makers
from mjx_grasp.evaluation.grasps.results import as_record
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.spec import RobotSpec, load_robot

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
    own = load_robot(config.robot)
    file = closing_policy(config.controller, config.policy, own)
    makers = Makers(config, own)
    made, settings = provenance(config.seed), to_record(config)

    def make(robot: RobotSpec, approach: Approach) -> Grasper:
        return loaded_grasper(robot, file, config.force_budget, approach=approach)

    done = _finished(config.out, settings, made, console)
    for name, scenario in scenarios.items():
        if name not in done:
            makers.objects(scenario)  # refuses before anything long starts
    with counting_progress(console) as bar:
        for name, scenario in scenarios.items():
            job = bar.add_task(name, total=_PERCENT, completed=_PERCENT if name in done else 0)
            if name in done:
                continue
            done[name] = _run(scenario, make, makers, bar, job)
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


def _run(
    scenario: Scenario, make: MakeGrasper, makers: Makers, bar: Progress, job: Any
) -> dict[str, Any]:
    started = time.perf_counter()
    rows = makers.run(
        scenario, make, lambda share: bar.update(job, completed=round(_PERCENT * share))
    )
    seconds = round(time.perf_counter() - started, 1)
    return {"settings": to_record(scenario), "seconds": seconds, **as_record(rows)}


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
