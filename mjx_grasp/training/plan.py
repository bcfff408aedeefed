"""A plan of trainings: settings, objects and seeds, read from YAML as flags of `train`."""

from __future__ import annotations

import itertools
import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.strict_yaml import load_yaml

_OWN = ("out", "resume", "seed")
"""Flags of `train` that are not for a plan's settings."""
_PLAN = "a mapping with `seeds`, `settings` and, if wanted, `flags` and `objects`"


class Run(NamedTuple):
    """One training of a plan."""

    name: str
    setting: str
    objects: str
    seed: int
    flags: tuple[str, ...]
    """of `train`"""


def read_plan(path: Path, more: str = "") -> list[Run]:
    """The trainings of a plan, every combination once.

    Args:
        path: The plan.
        more: Flags that all have beside its own.

    Raises:
        InputError: These are none, or stand in the plan.
        FileError: It is no plan, or two of its trainings have the same name.
    """
    try:
        content = _mapping("the plan", load_yaml(path.read_text()))
        known = {"flags", "settings", "objects", "seeds"}
        if unknown := sorted(set(content) - known):
            raise ValueError(f"unknown: {', '.join(unknown)}")
        common = _flags_in("flags", content.get("flags"))
        settings = {
            _part(name): _flags_in(name, of)
            for name, of in _mapping("settings", content.get("settings")).items()
        }
        asked = _mapping("objects", content.get("objects", {"": []}))
        objects = {_part(name): _listed(name, of) for name, of in asked.items()}
        seeds = _listed("seeds", content.get("seeds"))
        if wrong := [seed for seed in seeds if type(seed) is not int]:
            raise ValueError(f"seeds: {wrong[0]!r} is no whole number")
        if not (settings and objects and seeds) or len(set(seeds)) < len(seeds):
            raise ValueError("no settings, objects or seeds, or a seed twice")
        if any(objects.values()) and any("objects" in of for of in (common, *settings.values())):
            raise ValueError("objects both as a flag and as sets")
    except (OSError, yaml.YAMLError, ValueError) as error:
        said = " ".join(str(error).split())
        raise FileError(path, f"no plan ({said})", _PLAN) from None
    taken = {*common, *(flag for of in settings.values() for flag in of)}
    words = _more_flags(more, taken | ({"objects"} if any(objects.values()) else set()))
    runs = []
    for setting, group, seed in itertools.product(settings, objects, seeds):
        of = common | settings[setting] | {"seed": seed}
        if objects[group]:
            of |= {"objects": objects[group]}
        name = "-".join(part for part in (setting, group, f"seed{seed}") if part)
        runs.append(Run(name, setting, group, seed, (*as_flags(of), *words)))
    for name, count in Counter(run.name for run in runs).items():
        if count > 1:
            expected = "names of settings and objects that make one of their own for each"
            raise FileError(path, f"{count} trainings with the name {name}", expected)
    return runs


def _more_flags(more: str, taken: Collection[str]) -> list[str]:
    """Words of a command line, whose flags a plan does not have.

    Raises:
        InputError: They cannot be split, or a flag is the plan's.
    """
    try:
        words = shlex.split(more)
    except ValueError as error:
        raise InputError("--flags", more, f"words of a command line ({error})") from None
    for word in words:
        flag = word.partition("=")[0].removeprefix("--")
        if word.startswith("--") and (flag in taken or flag in _OWN):
            raise InputError("--flags", word, "flags that are not the plan's")
    return words


def _mapping(name: str, value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name}: {value!r} is no mapping")
    return value


def _flags_in(name: object, value: Any) -> dict[str, Any]:
    """Flags by the names that `train` has for them, without those that the plan itself decides."""
    flags = {}
    for flag, of in _mapping(str(name), {} if value is None else value).items():
        typed = str(flag).replace("_", "-")
        if typed in _OWN:
            raise ValueError(f"{name}: {flag}, which a plan decides itself")
        if typed in flags:
            raise ValueError(f"{name}: {typed} stands twice")
        flags[typed] = of
    return flags


def _part(name: object) -> str:
    """A part of the name of a training's folder."""
    if re.fullmatch(r"(\w[\w.+-]*)?", str(name)) is None:
        raise ValueError(f"{name!r} as a name: letters, digits and . + - _ alone")
    return str(name)


def _listed(name: object, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name}: {value!r} is no list")
    return value


def as_flags(values: Mapping[str, Any]) -> Iterator[str]:
    """Names and values of a plan as words of a command line."""
    for name, value in values.items():
        name = str(name).replace("_", "-")
        *parts, last = name.split(".")
        if value is False:
            yield "--" + ".".join((*parts, f"no-{last}"))
        elif value is True:
            yield f"--{name}"
        else:
            yield f"--{name}"
            yield from map(str, value if isinstance(value, list) else [value])
