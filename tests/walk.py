"""All settings classes of the package, with values that each of their fields may have and not."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
import types
from pathlib import Path
from typing import Literal, Union, get_args, get_origin

import mjx_grasp
from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import CommandSettings, Range, Settings, Several, Suffix, _hints

SUFFIXES = (".json", ".npz", ".png", ".onnx", "")


def settings_classes():
    """Every class of the package that derives from `Settings`."""
    for module in pkgutil.walk_packages(mjx_grasp.__path__, "mjx_grasp."):
        if module.name.split(".")[1] != "_assets":
            importlib.import_module(module.name)

    def below(kind):
        return {kind}.union(*map(below, kind.__subclasses__()))

    ours = {kind for kind in below(Settings) if kind.__module__.startswith("mjx_grasp.")}
    return sorted(ours - {Settings, CommandSettings}, key=lambda kind: kind.__qualname__)


def bare(hint):
    """A type without its annotation, and what is annotated."""
    inner, extras = hint, ()
    if hasattr(hint, "__metadata__"):
        inner, *extras = get_args(hint)
    return inner, extras


def one_of(extras, kind):
    return next((e for e in extras if isinstance(e, kind)), None)


def numbers(hint):
    """Of each number in a type whether it has a range."""
    inner, extras = bare(hint)
    if inner in (int, float):
        yield one_of(extras, Range) is not None
    for argument in get_args(inner):
        if get_origin(inner) is not Literal:
            yield from numbers(argument)


def possible(hint):
    """A value that a field of a type may have."""
    inner, extras = bare(hint)
    arguments = get_args(inner)
    if get_origin(inner) in (Union, types.UnionType):
        return None if type(None) in arguments else possible(arguments[0])
    if get_origin(inner) is Literal:
        return arguments[0]
    if get_origin(inner) is tuple:
        several = one_of(extras, Several)
        count = len(arguments) if arguments[1:] != (...,) else several.least if several else 0
        values = [possible(arguments[0 if arguments[1:] == (...,) else k]) for k in range(count)]
        if several and several.strictly:
            values = [value * (k + 1) for k, value in enumerate(values)]
        return tuple(values)
    if inner in (int, float):
        allowed = one_of(extras, Range) or Range()
        return inner(next(x for x in (1, 0.5, 0, allowed.low, allowed.high) if allowed.holds(x)))
    if inner is Path:
        suffix = one_of(extras, Suffix)
        return Path(f"x{suffix.names[0] if suffix else ''}")
    if dataclasses.is_dataclass(inner):
        return example(inner)
    return {str: "x", bool: True, dict: {}}.get(get_origin(inner) or inner)


def example(kind):
    """An instance, with defaults wherever there are any."""
    required = {
        f.name: possible(_hints(kind)[f.name])
        for f in dataclasses.fields(kind)
        if f.default is f.default_factory is dataclasses.MISSING
    }
    for suffix in SUFFIXES:
        try:
            paths = {k: v.with_suffix(suffix) for k, v in required.items() if isinstance(v, Path)}
            return kind(**(required | paths))
        except InputError as error:
            last = error
    raise last


def outside(kind, allowed):
    """Numbers just outside a range, and what is no number of this kind at all."""
    step = {
        int: lambda x, to: int(x) + int(math.copysign(1, to)),
        float: lambda x, to: math.nextafter(x, to),
    }[kind]
    if math.isfinite(allowed.low):
        yield kind(allowed.low) if allowed.above else step(allowed.low, -math.inf)
    if math.isfinite(allowed.high):
        yield step(allowed.high, math.inf)
    yield from (math.nan, 10**400, "1", True, (1,))
    yield from (x for x in (math.inf, -math.inf) if not allowed.holds(x))
    if kind is int:
        yield 1.5


def impossible(hint, value):
    """Values that a field of a type may not have.

    Args:
        hint: The type.
        value: One that it may have.
    """
    inner, extras = bare(hint)
    arguments = get_args(inner)
    if get_origin(inner) in (Union, types.UnionType):
        others = [a for a in arguments if a is not type(None)]
        for argument in others:
            good = value if value is not None else possible(argument)
            # What another kind of value may be is none of this one's business.
            bad = (v for v in impossible(argument, good) if v is not None)
            yield from (v for v in bad if len(others) == 1 or v != "1")
        return
    if type(None) not in arguments:
        yield None
    if get_origin(inner) is Literal:
        yield "no such"
    elif get_origin(inner) is tuple:
        value = value or (possible(arguments[0]),)
        yield from (list(value), value[0], "1")
        if arguments[1:] != (...,):
            yield from (value[:-1], (*value, value[-1]))
        for k, single in enumerate(value):
            each = arguments[0 if arguments[1:] == (...,) else k]
            yield from ((*value[:k], bad, *value[k + 1 :]) for bad in impossible(each, single))
        several = one_of(extras, Several)
        if several and several.least and arguments[1:] == (...,):
            yield ()
        if several and several.ascending and len(set(value)) > 1:
            yield value[::-1]
        if several and several.strictly:
            yield (value[0],) * len(value)
    elif inner in (int, float):
        yield from outside(inner, one_of(extras, Range) or Range(finite=False))
    elif inner is Path:
        yield "x.json"
        suffix = one_of(extras, Suffix)
        if suffix:
            yield Path(f"x{suffix.names[0]}.other")
    else:
        yield 3
