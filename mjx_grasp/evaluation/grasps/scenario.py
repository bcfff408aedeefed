"""What happens during a grasp that nobody told the controller of: one small file per scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.records.settings import (
    NonNegative,
    Positive,
    PositiveOrNever,
    Range,
    Settings,
    Share,
    from_record,
)
from mjx_grasp.records.strict_yaml import load_yaml

NOMINAL = "nominal"
LONGEST_DELAY_S = 0.5
"""Of a tracker."""
_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """How the controller is told where the object is."""

    position: NonNegative = 0.0
    """standard deviation of each coordinate of a reading [m]"""
    rotation: NonNegative = 0.0
    """standard deviation of the angle about each axis [rad]"""
    delay: Annotated[float, Range(0, LONGEST_DELAY_S)] = 0.0
    """age of a reading [s]"""
    dropout: Share = 0.0
    """share of the readings that are lost; the last one stands [-]"""
    period: NonNegative = 0.0
    """time from one reading to the next, in whole control periods and one at least [s]"""


@dataclass(frozen=True)
class BeltConfig(Settings):
    """The object is carried along the table as by a belt, until it is lifted."""

    speed: NonNegative = 0.0
    """[m/s]"""
    heading: Literal["anywhere", "across"] = "anywhere"
    """a random direction, or in front of the robot from the side where the object lies to the
    other"""
    starts_s: NonNegative = 0.0
    """after the start [s]"""
    when_near: PositiveOrNever = float("inf")
    """and not before every tip has come this near to its target [m]"""
    lasts_s: PositiveOrNever = float("inf")
    """[s]"""


@dataclass(frozen=True)
class PushConfig(Settings):
    """A level force on the object, in a random direction, once it has been lifted."""

    force: NonNegative = 0.0
    """[N]"""
    after_s: NonNegative = 0.5
    """from the end of the lift [s]"""
    lasts_s: NonNegative = 0.5
    """[s]"""


@dataclass(frozen=True)
class ObstacleConfig(Settings):
    """A ball on the straight way from the hand to the object; to touch it is to fail."""

    radius: Positive = 0.05
    """[m]"""
    along: Share = 0.5
    """where on that way its centre is, 0 at the fingertips at home and 1 at the object [-]"""
    clear: NonNegative = 0.16
    """least distance of its centre from the object's origin: nearer, it is moved back [m]"""


@dataclass(frozen=True)
class Scenario(Settings):
    """The circumstances of a grasp. By default nothing happens."""

    description: str = "nothing happens"
    """in a few words"""
    objects: tuple[str, ...] = ()
    """instead of those that are asked for"""
    away: NonNegative = 0.0
    """least distance of the object's origin from the fingertips at home [m]"""
    approach: Approach = "any"
    """from where the hand is told to come"""
    table_height: Annotated[float, Range(-0.2, 0.2)] = 0.0
    """of the table top above the robot's base [m]"""
    mass_scale: Positive = 1.0
    """of the object's mass; the controller believes it to be 1 [-]"""
    weighed: bool = True
    """whether the controller knows the weight; else its grip learns of it in the lift alone"""
    told: bool = True
    """whether fingertips tell what they touch; else the momentum observer alone does"""
    hold_s: Positive = 1.0
    """time at the top after which a trial may end, once its nine seconds are over [s]"""
    tracker: TrackerConfig = TrackerConfig()
    """of the object's pose"""
    belt: BeltConfig = BeltConfig()
    """under the object"""
    push: PushConfig = PushConfig()
    """against the object"""
    obstacles: tuple[ObstacleConfig, ...] = ()
    """in the hand's way; the controller is told of them"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.push.force and self.push.after_s + self.push.lasts_s >= self.hold_s:
            push = f"a push until {self.push.after_s + self.push.lasts_s} s"
            raise InputError(self.name_of("hold_s"), self.hold_s, f"more: it ends with {push}")


def scenario_names() -> tuple[str, ...]:
    """Those that are shipped; the first is the one in which nothing happens."""
    found = sorted(path.stem for path in asset_path("scenarios").glob("*.yaml"))
    return (NOMINAL, *(name for name in found if name != NOMINAL))


def load_scenario(name: str) -> tuple[str, Scenario]:
    """One scenario, and what it is called.

    Args:
        name: A shipped one, or a file of your own.

    Raises:
        InputError: An unknown name.
        FileError: A file that cannot be read, or is no scenario.
    """
    if not name.endswith(_SUFFIXES) and name not in (shipped := scenario_names()):
        raise InputError("--scenario", name, f"a file (.yaml), or one of {', '.join(shipped)}")
    ((stem, scenario),) = load_scenarios([name]).items()
    return stem, scenario


def load_scenarios(names: Sequence[str]) -> dict[str, Scenario]:
    """Scenarios by name.

    Args:
        names: Shipped ones, ``all`` of them, or files of your own.

    Raises:
        InputError: An unknown name, or one given twice.
        FileError: A file that cannot be read, or is no scenario.
    """
    shipped, found = scenario_names(), {}
    for name in (each for asked in names for each in (shipped if asked == "all" else [asked])):
        own = name.endswith(_SUFFIXES)
        if not own and name not in shipped:
            among = f"all, a file (.yaml), or one of {', '.join(shipped)}"
            raise InputError("--scenarios", name, among)
        path = Path(name) if own else asset_path("scenarios", f"{name}.yaml")
        if path.stem in found:
            raise InputError("--scenarios", path.stem, "each name once")
        found[path.stem] = _read(path)
    return found


def _read(path: Path) -> Scenario:
    try:
        content = load_yaml(path.read_text())
    except OSError as error:
        raise FileError(path, error.strerror or "no file", "a scenario") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        found = " ".join(str(error).split())
        raise FileError(path, f"no valid YAML ({found})", "a scenario") from error
    try:
        return from_record(Scenario, content, "scenario")
    except InputError as error:
        raise InputError(f"{path}: {error.field}", error.found, error.expected) from None
