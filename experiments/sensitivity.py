"""What it costs when robot or object differ from their model: success, one change at a time.

Nominal are an object offset of ±5 mm, friction 0.8, and mass, finger stiffness and torque limit as
modelled. The policy is not told what differs. All controllers have the same draws under all
conditions, and nominal trials are run once. What is in the file already, of the same settings and
revision of the code, is left alone, so that an interrupted run goes on.

  python experiments/sensitivity.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import tyro
from compared import (
    ComparedConfig,
    Condition,
    Runner,
    compared,
    compiled_for,
    journal_of,
    keep,
)
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.evaluation.trials import evenly, room_for
from mjx_grasp.records.journal import journaled
from mjx_grasp.records.settings import Positive, Several
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.config import RobotErrors, StartNoise

SCHEMA = "mjx_grasp.sensitivity/1"
_WHAT = "a table of sensitivities"
Cell = tuple[str, str, float]
"""A controller, what differs, and how much."""
NOMINAL = {"friction": 0.8, "mass": 1.0, "stiffness": 1.0, "torque": 1.0}
"""Of each factor: what trials under another one have."""
_NOISE = StartNoise(offset_m=0.005, friction=(NOMINAL["friction"],) * 2)
_DRAWN: dict[str, Callable[[float], StartNoise]] = {
    "friction": lambda x: replace(_NOISE, friction=(x, x)),
    "mass": lambda x: replace(_NOISE, mass_scale=(x, x)),
    "stiffness": lambda x: replace(_NOISE, robot=RobotErrors(stiffness=(x, x))),
}

Values = Annotated[tuple[Positive, ...], Several(ascending=True, strictly=True)]


@dataclass(frozen=True)
class SensitivityConfig(ComparedConfig):
    """Which controllers, and what differs; a factor with its nominal value alone is left out."""

    out: Path = Path("experiments/results/sensitivity.json")
    frictions: Values = (0.4, 0.6, 0.8, 1.0, 1.2)
    """sliding frictions of every contact with the object [-]"""
    masses: Values = (0.5, 0.75, 1.0, 1.5, 2.0)
    """factors on the object's mass [-]"""
    stiffnesses: Values = (0.5, 0.7, 1.0, 1.4, 2.0)
    """factors on the position gains of the fingers [-]"""
    torques: Values = (0.25, 0.5, 0.75, 1.0)
    """factors on the torque limits of the finger actuators [-]"""


def changes(config: SensitivityConfig) -> dict[str, list[float]]:
    """The values of each factor that are not nominal; of factors that have any."""
    asked = (config.frictions, config.masses, config.stiffnesses, config.torques)
    apart = {
        factor: [x for x in values if x != nominal]
        for (factor, nominal), values in zip(NOMINAL.items(), asked, strict=True)
    }
    return {factor: values for factor, values in apart.items() if values}


def _limit(cell: Cell) -> float:
    """Factor on the fingers' torque limits in a cell's scene."""
    _, factor, value = cell
    return value if factor == "torque" else NOMINAL["torque"]


def _condition(cell: Cell) -> Condition:
    _, factor, value = cell
    at = {} if factor == "nominal" else {"value": value}
    return at, _DRAWN[factor](value) if factor in _DRAWN else _NOISE


def batches(cells: Sequence[Cell], room: int) -> list[Sequence[Cell]]:
    """Cells of one controller and scene, as many as have room beside each other.

    One scene comes after the other, for a controller is compiled for each.
    """

    def scene(cell: Cell) -> tuple[bool, float]:
        return cell[1] == "torque", _limit(cell)

    alike = groupby(sorted(cells, key=scene), key=lambda cell: (scene(cell), cell[0]))
    return [some for _, own in alike for some in evenly(list(own), room)]


class Runners:
    """One runner for each limit of the fingers' torques, in which alone scenes differ."""

    def __init__(self, config: SensitivityConfig, most: dict[float, int]):
        found = compared(config, SCHEMA, _WHAT)

        def runner(limit: float) -> Runner:
            physics, drawn = SceneConfig(finger_torque=limit), (config.episodes, config.seed)
            return Runner(found, *drawn, config.engine, physics, beside=most[limit])

        self._of = functools.lru_cache(maxsize=1)(runner)

    def rows(self, cells: Sequence[Cell]) -> list[list[dict[str, Any]]]:
        """A controller's rows in each of some cells of one scene."""
        return self._of(_limit(cells[0])).rows(cells[0][0], [_condition(each) for each in cells])


def main(config: SensitivityConfig) -> None:
    """Runs what is not there yet."""
    found = compared(config, SCHEMA, _WHAT)
    found.record["nominal"] = NOMINAL
    done, asked = found.record["controllers"], {"nominal": [1.0]} | changes(config)
    cells = [
        (name, factor, value)
        for name in found.contestants
        for factor in asked
        for value in asked[factor]
    ]
    # What is beside what does not depend on what is finished: the journal knows it by that.
    every = batches(cells, room_for(config.engine, config.episodes * len(found.names)))
    most: dict[float, int] = {}
    for some in every:
        limit = _limit(some[0])
        most[limit] = max(most.get(limit, 0), len(some))
    beside = [s for s in every if any(factor not in done.get(name, {}) for name, factor, _ in s)]
    jobs = [(f"{some}", some) for some in beside]
    journal = journal_of(config, found)
    setup = functools.partial(Runners, config, most)

    def kind(some: Sequence[Cell]) -> Hashable:
        return _limit(some[0]), compiled_for(found.contestants[some[0][0]])

    results = journaled(config, Runners.rows, jobs, setup, journal, kind=kind)
    ended: dict[Cell, list[dict[str, Any]]] = {}
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("conditions", total=sum(map(len, beside)))
        for some, rows in zip(beside, results, strict=True):
            ended |= zip(some, rows, strict=True)
            bar.update(job, advance=len(some))
            for name, factor, _ in some:
                own = [(name, factor, value) for value in asked[factor]]
                if all(each in ended for each in own):
                    done.setdefault(name, {})[factor] = [row for each in own for row in ended[each]]
            keep(config, found)
    journal.close()


if __name__ == "__main__":
    import sensitivity as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.SensitivityConfig, description=__doc__)))
