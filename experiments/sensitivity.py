"""What it costs when robot or object differ from their model: success, one change at a time.

Nominal are an object offset of ±5 mm, friction 0.8, and mass, finger stiffness and torque limit as
modelled. The policy is not told what differs. All controllers have the same draws under all
conditions, and nominal trials are run once. What is in the file already, of the same settings and
revision of the code, is left alone, so that an interrupted run goes on.

  python experiments/sensitivity.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import tyro
from compared import ComparedConfig, Runner, compared, journal_of, keep
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
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


class Runners:
    """One runner for each limit of the fingers' torques, in which alone scenes differ."""

    def __init__(self, config: SensitivityConfig):
        found = compared(config, SCHEMA, _WHAT)
        self._of = functools.cache(
            lambda limit: Runner(
                found, config.episodes, config.seed, config.engine, SceneConfig(finger_torque=limit)
            )
        )

    def rows(self, cell: Cell) -> list[dict[str, Any]]:
        """A controller's rows under one value of a factor."""
        name, factor, value = cell
        at = {} if factor == "nominal" else {"value": value}
        noise = _DRAWN[factor](value) if factor in _DRAWN else _NOISE
        return self._of(_limit(cell)).rows(name, at, noise)


def main(config: SensitivityConfig) -> None:
    """Runs what is not there yet."""
    found = compared(config, SCHEMA, _WHAT)
    found.record["nominal"] = NOMINAL
    done, asked = found.record["controllers"], {"nominal": [1.0]} | changes(config)
    left = [
        (name, factor)
        for name in found.contestants
        for factor in asked
        if factor not in done.get(name, {})
    ]
    cells = [(name, factor, value) for name, factor in left for value in asked[factor]]
    # One scene after the other: a controller is compiled for each.
    cells.sort(key=lambda cell: (cell[1] == "torque", _limit(cell)))
    jobs = [(f"{name}, {factor} {value}", (name, factor, value)) for name, factor, value in cells]
    journal = journal_of(config, found)
    setup = functools.partial(Runners, config)
    results = journaled(config, Runners.rows, jobs, setup, journal, kind=itemgetter(0))
    ended: dict[Cell, list[dict[str, Any]]] = {}
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("conditions", total=len(cells))
        for cell, rows in zip(cells, results, strict=True):
            ended[cell] = rows
            bar.update(job, advance=1)
            name, factor, _ = cell
            own = [(name, factor, value) for value in asked[factor]]
            if all(each in ended for each in own):
                done.setdefault(name, {})[factor] = [row for each in own for row in ended[each]]
                keep(config, found)
    journal.close()


if __name__ == "__main__":
    import sensitivity as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.SensitivityConfig, description=__doc__)))
