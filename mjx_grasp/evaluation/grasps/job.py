"""Scenarios one after the other, from settings to a results file."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps.blocks import Part, joined
from mjx_grasp.evaluation.grasps.config import ScenariosConfig, warn_without_gpu
from mjx_grasp.evaluation.grasps.makers import Makers, compiled_for
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal, goes_on, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.records.spread import unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.scenarios/1"
_PERCENT = 100


@contextmanager
def _naming(scenario: str) -> Iterator[None]:
    """Says of what is refused in which scenario it is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{scenario}: {error.field}", error.found, error.expected) from None


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

    def check(self, name: str, scenario: Scenario, parts: Sequence[Part]) -> None:
        """Refuses a scenario before anything long starts.

        Raises:
            InputError, FileError: It cannot work.
        """
        with _naming(name):
            self.makers.check(scenario, self._make, parts)

    def meshes(self, name: str, scenario: Scenario) -> dict[str, str]:
        """What tells its objects' meshes from others of the same names.

        Raises:
            InputError, FileError: They cannot be had.
        """
        with _naming(name):
            return {obj.name: obj.content_hash for obj in self.makers.objects(scenario)}

    def part(self, job: tuple[list[Scenario], Part]) -> list[dict[str, Any]]:
        """What came of a part of each of some scenarios."""
        scenarios, part = job
        return self.makers.part(scenarios, self._make, part, self._progress)

    def _make(self, robot: RobotSpec, approach: Approach) -> Grasper:
        return loaded_grasper(robot, self.file, self._config.force_budget, approach=approach)


def run_scenarios(config: ScenariosConfig, console: Console) -> dict[str, Any]:
    """Runs what is asked for and writes the file after each batch of scenarios, see `Makers`.

    Parts of the trials that are finished before are in the journal.

    Args:
        config: Scenarios, objects, controller, file, and who shares the parts.
        console: For progress.

    Returns:
        What the file holds.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_writable("--out", config.out)
    scenarios, made = load_scenarios(config.scenarios), provenance(config.seed)
    # The scenarios whose turn it is, and their finished parts.
    batch, found = list[str](), list[list[dict[str, Any]]]()
    with counting_progress(console) as bar:

        def show(share: float) -> None:
            for name in batch:
                bar.update(bars[name], completed=_PERCENT * (len(found) + share))

        own = _Grasps(config, show)
        warn_without_gpu(config.engine, console)
        header = {"schema": SCHEMA, "config": to_record(unspread(config))}
        header |= {"sha256": file_digests(policy=own.file), "device": jax.default_backend()}
        header |= {"robot": to_record(load_robot(config.robot).identity)}
        about = {
            name: {"settings": to_record(scenario), "meshes": own.meshes(name, scenario)}
            for name, scenario in scenarios.items()
        }
        done = _before(config.out, header, made["git"], about)
        parts = own.makers.parts()
        left = [name for name in scenarios if name not in done]
        for name in left:
            own.check(name, scenarios[name], parts)
        batches = own.makers.batches(left, lambda name: compiled_for(scenarios[name]))
        jobs = [
            (
                f"{', '.join(names)}: blocks {part[0].number} to {part[-1].number}",
                ([scenarios[name] for name in names], part),
            )
            for names in batches
            for part in parts
        ]
        journal = Journal(config.out, header | {"scenarios": about}, made["git"])
        kept = sum(job in journal.done for job, _ in jobs)
        if done or kept:
            after = [*done, *([f"{kept} parts of the trials"] if kept else [])]
            console.print(f"{config.out}: goes on after {', '.join(after)}")
        whole = _PERCENT * len(parts)
        bars = {
            name: bar.add_task(name, total=whole, completed=whole if name in done else 0)
            for name in scenarios
        }
        setup = (lambda: own) if config.alone else partial(_Grasps, config)
        results = journaled(
            config, _Grasps.part, jobs, setup, journal, kind=lambda job: compiled_for(job[0][0])
        )
        for batch in batches:
            found = []
            for _ in parts:
                found.append(next(results))
                show(0.0)
            for name, own_parts in zip(batch, zip(*found, strict=True), strict=True):
                done[name] = about[name] | joined(own_parts)
            ordered = {name: done[name] for name in scenarios if name in done}
            write_json(config.out, header | {"scenarios": ordered, "provenance": made})
            for name in batch:
                _warn(name, done[name]["all"], console)
    journal.close()
    return {"config": header["config"], "scenarios": {name: done[name] for name in scenarios}}


def _warn(name: str, summed: dict[str, Any], console: Console) -> None:
    """Says which trials cannot be trusted: contacts were left out, or the numbers were none."""
    if summed["overflows"]:
        ticks = f"{summed['overflows']} ticks with more contacts than buffers hold"
        console.print(f"[yellow]{name}: {ticks}; some were left out[/yellow]")
    if summed["broken"]:
        which = f"{summed['broken']} of {summed['trials']} worlds broken"
        console.print(f"[yellow]{name}: {which}; their states stopped being finite[/yellow]")


def _before(
    path: Path, header: dict[str, Any], git: str, about: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """Which of the scenarios a run of the same settings, policy and revision has finished."""
    if not path.exists():
        return {}
    try:
        before = json.loads(path.read_text())
        found = before["scenarios"]
        if not goes_on(before, header, git):
            return {}
        return {k: found[k] for k, of in about.items() if of.items() <= found.get(k, {}).items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise FileError(path, "no results of scenarios", "none, or such a file") from None
