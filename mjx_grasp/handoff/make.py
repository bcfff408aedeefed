"""The handoff set of a configuration, made object by object, saved and reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import TaskID

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs, merge
from mjx_grasp.handoff.generate import HandoffGenerator
from mjx_grasp.handoff.reached import ReachedGenerator
from mjx_grasp.handoff.record import as_record, from_record
from mjx_grasp.handoff.report import ObjectReport, read_report, write_report
from mjx_grasp.objects.catalogue import load_catalogue, resolve
from mjx_grasp.objects.model import ObjectModel, load_objects, stand_in_hash
from mjx_grasp.records.atomic import check_writable
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.records.spread import unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot

_ALONE: dict[str, Any] = {"reached_share": HandoffConfig.reached_share}
"""What one kind knows nothing of."""
_IK_ALONE: dict[str, Any] = {"kind": "ik", "gate": "default", "gate_midpoint": None, **_ALONE}
"""What a search for postures knows nothing of."""


Maker = Callable[[ObjectModel, Callable[[int], None]], tuple[HandoffSet, ObjectReport]]
"""Makes an object's states of one kind; the function given is told how many there are."""


def make_handoffs(
    config: HandoffConfig, console: Console | None = None
) -> tuple[HandoffSet, list[ObjectReport]]:
    """Makes, saves and reports the pre-grasps of all objects of a configuration.

    Writes the set to ``config.out`` and the report beside it, with the suffix ``.json``. An object
    without any pre-grasp is in the report, as not eligible, and in the set's names. Killed and
    called again, it goes on after the objects that were finished.

    Args:
        config: Settings.
        console: Where progress is shown; nowhere if None.

    Raises:
        InputError: An unknown object or robot, a robot that does not reach the table, a file that
            cannot be written, or no pre-grasp of any object; nothing is written then.
        FileError: An object's scan, the robot's description or a set to update cannot be read, or
            what would be replaced is something else.
    """
    check_writable("--out", config.out)
    _check_replaced(config.out)
    made = provenance(config.seed)  # of the code as it is before the set changes a tracked file
    names = resolve(config.objects)
    sets: list[HandoffSet] = []
    reports: list[ObjectReport] = []
    robot = load_robot(config.robot)
    before = [load_handoffs(path, robot=robot) for path in config.update]
    earlier = [read_report(path.with_suffix(".json")) for path in config.update]
    for k, given in enumerate(before):
        later = {*names, *(name for other in before[k + 1 :] for name in other.object_names)}
        kept = given.select([n for n in given.object_names if n not in later])
        _warn_of_mixed_shapes(kept, config, console)
        sets.append(kept)
    objects = load_objects(config.objects, config.objects_dir, weight=config.weight)
    settings = to_record(unspread(config))
    made_of = {
        "config": settings,
        "objects": {obj.name: obj.content_hash for obj in objects},
        "robot": to_record(robot.identity),
        "device": jax.default_backend(),
    }
    journal = Journal(config.out, made_of, made["git"])
    if console is not None and journal.done:
        console.print(f"{config.out}: goes on after {', '.join(journal.done)}")
    with counting_progress(console) as progress:
        finished = len(journal.done)
        everything = progress.add_task("all objects", total=len(objects) * config.per_object)
        bars: dict[str, TaskID] = {}

        def show(name: str, kept: int) -> None:
            if name not in bars:
                bars[name] = progress.add_task(name, total=config.per_object)
            progress.update(bars[name], completed=kept)
            progress.update(everything, completed=finished * config.per_object + kept)

        def show_finished(obj: ObjectModel) -> None:
            nonlocal finished
            finished += 1
            progress.update(everything, completed=finished * config.per_object)
            if obj.name in bars:
                progress.update(bars[obj.name], visible=False)

        setup = partial(_Making, config, *([show] if config.alone else []))
        dealt = objects if config.alone else largest_first(objects)
        jobs = [(obj.name, obj) for obj in dealt]
        progress.update(everything, completed=finished * config.per_object)
        results = journaled(config, _Making.states_of, jobs, setup, journal, show_finished)
        found = dict(zip((obj.name for obj in dealt), results, strict=True))
        for obj in objects:
            for record in found[obj.name]:
                states, report = from_record(record, obj, robot)
                sets.append(states)
                reports.append(report)
    merged = merge(sets)
    if len(merged) == 0:
        journal.close()
        raise InputError(
            "--objects",
            ", ".join(merged.object_names),
            "one or more with a pre-grasp: none was found in "
            f"{config.max_rounds} round(s), more --max-rounds may find some",
        )
    merged.save(config.out)
    write_report(config.out.with_suffix(".json"), reports, made, settings, earlier)
    journal.close()
    return merged, reports


def _check_replaced(out: Path) -> None:
    """Refuses to replace what is no set, and no report beside one.

    Raises:
        FileError: It is something else.
    """
    if out.exists():
        load_handoffs(out)
    if (report := out.with_suffix(".json")).exists():
        read_report(report)


def largest_first(objects: Sequence[ObjectModel]) -> list[ObjectModel]:
    """The order in which processes take objects.

    Large ones are seldom within reach and take longest: what is begun late is waited for.
    """
    return sorted(objects, key=lambda obj: -float(np.ptp(obj.mesh.vertices, axis=0).max()))


class _Making:
    """What every process that makes states needs.

    Args:
        config: Settings.
        show: Told of an object by its name how many states there are.
    """

    def __init__(
        self, config: HandoffConfig, show: Callable[[str, int], None] = lambda name, kept: None
    ):
        self._config, self._show = unspread(config), show
        self._makers = _makers(load_robot(config.robot), self._config)

    def states_of(self, obj: ObjectModel) -> list[dict[str, Any]]:
        """An object's states and reports of each kind, as records."""
        show = partial(self._show, obj.name)
        made = _of_each_kind(obj, self._makers, self._config, show)
        return [as_record(*each) for each in zip(*made, strict=True)]


def _makers(robot: RobotSpec, config: HandoffConfig) -> list[Maker]:
    """Those of the kinds that are wanted, ik before reached."""
    ik, reached = config.shares(config.per_object)
    makers: list[Maker] = []
    if ik:
        alone = replace(config, **_IK_ALONE, per_object=ik)
        makers.append(HandoffGenerator(robot, alone).generate)
    if reached:
        alone = replace(config, kind="reached", per_object=reached, **_ALONE)
        makers.append(ReachedGenerator(robot, alone).generate)
    return makers


def _of_each_kind(
    obj: ObjectModel, makers: Sequence[Maker], config: HandoffConfig, show: Callable[[int], None]
) -> tuple[list[HandoffSet], list[ObjectReport]]:
    """An object's states and reports, one of each maker."""
    sets: list[HandoffSet] = []
    reports: list[ObjectReport] = []
    for maker in makers:

        def together(kept: int, before: int = sum(map(len, sets))) -> None:
            show(before + kept)

        states, report = maker(obj, together)
        sets.append(states)
        reports.append(report)
    sets = mixture(sets, config)
    for states, report in zip(sets, reports, strict=True):
        report.keep(states, report.seconds)
    return sets, reports


def mixture(parts: Sequence[HandoffSet], config: HandoffConfig) -> list[HandoffSet]:
    """An object's states of each kind, as many as the share of the mixture lets it keep.

    Where one kind has fewer states than it should, the other gives up some of its own: the share
    holds for every object, if need be with none at all.

    Args:
        parts: One set per kind, ik before reached.
        config: How many, and the share.
    """
    if config.kind != "mixed":
        return list(parts)
    most = next(
        n
        for n in range(config.per_object, -1, -1)
        if n == 0 or all(0 < k <= len(p) for k, p in zip(config.shares(n), parts, strict=True))
    )
    return [p.take(np.arange(k)) for p, k in zip(parts, config.shares(most), strict=True)]


def _warn_of_mixed_shapes(kept: HandoffSet, config: HandoffConfig, console: Console | None) -> None:
    """Says so if the states taken over are of scans and the new ones of stand-ins, or reversed."""
    wanted, known = config.objects_dir is None, load_catalogue()
    stored = zip(kept.object_names, kept.object_content_hash, strict=True)
    other = [n for n, digest in stored if n in known and (stand_in_hash(n) == digest) != wanted]
    if other and console is not None:
        kinds = ("scans", "stand-ins") if wanted else ("stand-ins", "scans")
        console.print(
            f"[yellow]warning: the set's {', '.join(other)} are {kinds[0]} and the new objects "
            f"{kinds[1]}: no one command will take all of them[/yellow]"
        )
