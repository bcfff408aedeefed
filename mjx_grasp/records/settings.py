"""Settings: frozen dataclasses whose types say what is possible, and their form in files.

A field's type is its range: `speed: Positive = 0.1`. Every settings class derives from `Settings`,
which checks all fields when an instance is made, whatever made it: a command line, a preset, a
file. What no single field can say stands in the class's own `__post_init__`, which begins with
`super().__post_init__()`.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import itertools
import math
import operator
import sys
import types
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mjx_grasp.errors import InputError


@dataclass(frozen=True)
class Range:
    """What a number may be; part of a type: `Annotated[float, Range(0, 1)]`."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether it has to be more than `low`."""
    finite: bool = True
    """Whether infinity is ruled out."""

    def holds(self, value: float) -> bool:
        """Whether a number lies in the range; what is no number does not."""
        if not abs(value) <= sys.float_info.max and (self.finite or abs(value) != math.inf):
            return False
        return self.low < value <= self.high or (value == self.low and not self.above)

    def __str__(self) -> str:
        low = f"more than {_short(self.low)}" if self.above else f"{_short(self.low)} or more"
        if math.isfinite(self.low) and math.isfinite(self.high):
            between = f"{low}, at most" if self.above else f"{_short(self.low)} to"
            return f"{between} {_short(self.high)}"
        if math.isfinite(self.low):
            return low
        if math.isfinite(self.high):
            return f"at most {_short(self.high)}"
        return "a finite number" if self.finite else "a number"


def _short(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


@dataclass(frozen=True)
class Several:
    """How many values there are, and in what order; part of a type, as `Range` is."""

    least: int = 1
    ascending: bool = False
    """Whether no value may be less than the one before it."""
    strictly: bool = False
    """Whether each has to be more."""
    once: bool = False
    """Whether no value may come twice."""

    def holds(self, values: Collection[Any]) -> bool:
        """Whether there are as many and in order."""
        before = operator.lt if self.strictly else operator.le
        ordered = not self.ascending or all(before(a, b) for a, b in itertools.pairwise(values))
        repeats = self.once and len(set(values)) < len(values)
        return len(values) >= self.least and ordered and not repeats

    def __str__(self) -> str:
        order = "different ones in ascending order" if self.strictly else "in ascending order"
        order = order if self.ascending else "each once" if self.once else ""
        return f"{self.least} or more" + (f", {order}" if order else "")


@dataclass(frozen=True)
class Suffix:
    """How the name of a file ends; part of a type, as `Range` is."""

    names: tuple[str, ...]
    """with the dot"""

    def holds(self, path: Path) -> bool:
        """Whether a name ends so."""
        return path.suffix in self.names

    def __str__(self) -> str:
        return f"a file name ending in {' or '.join(self.names)}"


Finite = Annotated[float, Range()]
Positive = Annotated[float, Range(0, above=True)]
NonNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
PositiveOrNever = Annotated[float, Range(0, above=True, finite=False)]
"""A threshold that infinity switches off."""
_MOST = 2**31 - 1  # what an index of JAX holds
Count = Annotated[int, Range(1, _MOST)]
WholeNumber = Annotated[int, Range(0, _MOST)]
Interval = Annotated[tuple[Finite, Finite], Several(ascending=True)]
"""A lowest and a highest value."""
Seed = Annotated[int, Range(0, 2**32 - 1)]
"""What NumPy and JAX both take as a seed."""


@dataclass(frozen=True)
class Settings:
    """Base of all settings: every field is checked against its type."""

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for name, hint in _hints(kind).items():
            found = getattr(self, name)
            expected = _expected(hint, found)
            if expected is not None:
                found = str(found) if isinstance(found, Path) else found
                raise InputError(self.name_of(name), found, expected)

    def name_of(self, field_name: str) -> str:
        """What a field is called in messages: its flag, while a command line is read."""
        own = f"{type(self).__name__}.{field_name}"
        return (_flags.get() or {}).get((type(self), field_name), own)


@dataclass(frozen=True)
class CommandSettings(Settings):
    """Settings of a command: messages name the flags."""

    def name_of(self, field_name: str) -> str:
        """The flag."""
        return "--" + field_name.replace("_", "-")


Flags = dict[tuple[type, str], str]
_flags: ContextVar[Flags | None] = ContextVar("_flags", default=None)


@contextmanager
def named_as_flags(kind: type) -> Iterator[None]:
    """Has messages about settings within those of a command name the flags, while it lasts.

    Args:
        kind: The command's settings; those of a class that it has at two places keep their names.
    """
    found: dict[tuple[type, str], set[str]] = {}
    for key, flag in _flags_of(kind, ""):
        found.setdefault(key, set()).add(flag)
    before = _flags.set({key: flags.pop() for key, flags in found.items() if len(flags) == 1})
    try:
        yield
    finally:
        _flags.reset(before)


def _flags_of(kind: type, prefix: str) -> Iterator[tuple[tuple[type, str], str]]:
    """The flags of a class's fields, and of those of the settings within it."""
    for name, hint in _hints(kind).items():
        bare, _ = _bare(hint)
        said = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        alone = any(getattr(extra, "prefix_name", None) is False for extra in said)
        nameless = any(getattr(extra, "name", None) == "" for extra in said)
        flag = ("" if alone else prefix) + name.replace("_", "-")
        yield (kind, name), f"--{flag}"
        members = get_args(bare) if get_origin(bare) in (Union, types.UnionType) else [bare]
        for inner in members:
            if isinstance(inner, type) and issubclass(inner, Settings):
                yield from _flags_of(inner, prefix if nameless else f"{flag}.")


def added(default: Any, absent: Any) -> Any:
    """A field that came after files were written without it.

    Args:
        default: What it is today.
        absent: What stands for files that do not have it: the value that changes nothing.
    """
    return field(default=default, metadata={"absent": absent})


_INFINITE = (math.inf, -math.inf)


def to_record(value: Any) -> Any:
    """Settings as plain values of JSON, which knows no infinity: it becomes a word."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_record(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple | list):
        return [to_record(item) for item in value]
    return str(value) if isinstance(value, Path) or value in _INFINITE else value


S = TypeVar("S")


def from_record(kind: type[S], record: Any, where: str = "") -> S:
    """Settings from what `to_record` made, today or before fields were added.

    Args:
        kind: The class.
        record: Values of JSON.
        where: What the record is called in messages.

    Raises:
        InputError: It is no record of this class: an unknown field, a missing one without a
            default, or an impossible value.
    """
    where = where or kind.__name__
    cached: Any = kind  # of whose hash a type checker thinks as an instance's
    fields = {f.name: f for f in dataclasses.fields(cached)}
    if not isinstance(record, Mapping):
        raise InputError(where, record, f"a mapping of some of {', '.join(fields)}")
    unknown = sorted(set(record) - set(fields))
    if unknown:
        raise InputError(where, ", ".join(unknown), _meant(unknown, fields))
    hints, values = _hints(cached), {}
    for name, known in fields.items():
        if name in record:
            values[name] = _value(hints[name], record[name], f"{where}.{name}")
            if (expected := _expected(hints[name], values[name])) is not None:
                raise InputError(f"{where}.{name}", record[name], expected)
        elif "absent" in known.metadata:
            values[name] = known.metadata["absent"]
        elif known.default is known.default_factory is dataclasses.MISSING:
            raise InputError(f"{where}.{name}", "nothing", "a value")
    return kind(**values)


def _meant(unknown: Sequence[str], fields: Collection[str]) -> str:
    """What was probably meant, and what there is."""
    near = [m for name in unknown for m in difflib.get_close_matches(name, fields, n=1)]
    return f"some of {', '.join(fields)}" + (f" ({', '.join(near)}?)" if near else "")


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


Limit = Range | Several | Suffix


def _bare(hint: Any) -> tuple[Any, Collection[Limit]]:
    """A type without its annotation, and the limits among it."""
    if get_origin(hint) is not Annotated:
        return hint, []
    inner, *extras = get_args(hint)
    return inner, [e for e in extras if isinstance(e, Limit)]


def _expected(hint: Any, value: Any) -> str | None:
    """What a value should have been; None if it is that."""
    bare, limits = _bare(hint)
    origin, arguments = get_origin(bare), get_args(bare)
    if origin in (Union, types.UnionType):
        each = [_expected(argument, value) for argument in arguments]
        return None if None in each else ", or ".join(map(str, each))
    if origin is Literal:
        return None if value in arguments else f"one of {', '.join(map(str, arguments))}"
    if bare in (int, float):
        return _expected_number(bare, limits or [Range(finite=False)], value)
    if origin is tuple:
        wrong = _expected_values(arguments, value)
    elif isinstance(kind := origin or bare, type) and not isinstance(value, kind):
        wrong = "None" if kind is type(None) else f"a {kind.__name__}"
    else:
        wrong = None
    return wrong or next((str(limit) for limit in limits if not limit.holds(value)), None)


def _expected_number(kind: type, limits: Collection[Any], value: Any) -> str | None:
    is_number = isinstance(value, (kind, int)) and not isinstance(value, bool)
    if is_number and all(limit.holds(value) for limit in limits):
        return None
    return ("a whole number, " if kind is int else "") + " and ".join(map(str, limits))


def _expected_values(arguments: tuple[Any, ...], value: Any) -> str | None:
    if not isinstance(value, tuple):
        return "several values"
    hints = [arguments[0]] * len(value) if arguments[1:] == (...,) else list(arguments)
    if len(hints) != len(value):
        return f"{len(hints)} values"
    each = filter(None, map(_expected, hints, value))
    return next((f"of each: {wrong}" for wrong in each), None)


def _value(hint: Any, value: Any, where: str) -> Any:
    """A value of JSON as the type has it; what does not fit is left for the check."""
    bare, _ = _bare(hint)
    arguments = get_args(bare)
    if get_origin(bare) in (Union, types.UnionType):
        inner = [a for a in arguments if a is not type(None)]
        return value if value is None else _value(inner[0], value, where)
    if get_origin(bare) is tuple and isinstance(value, list):
        each = itertools.repeat(arguments[0]) if arguments[1:] == (...,) else arguments
        numbered = enumerate(zip(each, value, strict=False))
        known = tuple(_value(h, v, f"{where}[{i}]") for i, (h, v) in numbered)
        return (*known, *value[len(known) :])
    if isinstance(bare, type) and dataclasses.is_dataclass(bare):
        return from_record(bare, value, where)
    if bare is float and value in map(str, _INFINITE):
        return float(value)
    return Path(value) if bare is Path and isinstance(value, str) else value
