"""Settings say in their types what is possible, and come back from files as they were."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tyro
import walk
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import (
    CommandSettings,
    Count,
    Finite,
    Interval,
    NonNegative,
    Positive,
    PositiveOrNever,
    Range,
    Seed,
    Settings,
    Several,
    Share,
    Suffix,
    WholeNumber,
    added,
    from_record,
    named_as_flags,
    to_record,
)


@dataclass(frozen=True)
class Part(Settings):
    speed: Positive = 0.1
    name: str = "part"


@dataclass(frozen=True)
class Whole(Settings):
    out: Annotated[Path, Suffix((".json", ".csv"))]
    count: Count = 1
    number: WholeNumber = 0
    seed: Seed = 0
    place: Finite = 0.0
    weight: NonNegative = 0.0
    share: Share = 0.5
    timeout: PositiveOrNever = math.inf
    angle: Annotated[float, Range(-1, 1)] = 0.0
    below: Annotated[float, Range(high=3)] = 0.0
    kind: Literal["a", "b"] = "a"
    limit: Positive | None = None
    either: Literal["auto"] | Count = "auto"
    layers: Annotated[tuple[Count, ...], Several()] = (8,)
    names: Annotated[tuple[str, ...], Several(0, once=True)] = ()
    interval: Interval = (0.0, 1.0)
    span: Annotated[tuple[Positive, Positive], Several(ascending=True, strictly=True)] = (0.1, 0.2)
    box: tuple[Positive, NonNegative] = (1.0, 0.0)
    on: bool = False
    extra: dict[str, Any] = field(default_factory=dict)
    part: Part = field(default_factory=Part)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.number > 100 * self.count:
            raise InputError(self.name_of("number"), self.number, "at most 100 times count")


@dataclass(frozen=True)
class Command(CommandSettings):
    world_count: Count = 1


def whole(**fields):
    return Whole(**({"out": Path("x.json")} | fields))


BOUNDS = {
    "count": (1, 2**31 - 1),
    "number": (0, 100),
    "seed": (0, 2**32 - 1),
    "place": (-sys.float_info.max, sys.float_info.max, 3),
    "weight": (0, 0.0, sys.float_info.max),
    "share": (0.0, 1.0),
    "timeout": (5e-324, math.inf),
    "angle": (-1.0, 1.0),
    "below": (-1e300, 3.0),
    "limit": (None, 5e-324),
    "either": ("auto", 1),
    "layers": ((1,), (1, 2, 3)),
    "names": ((), ("a",)),
    "interval": ((0.0, 0.0), (-1.0, 1.0)),
    "box": ((5e-324, 0.0),),
    "out": (Path("a.json"), Path("b.csv")),
    "kind": ("a", "b"),
    "on": (True, False),
    "extra": ({}, {"a": 1}),
    "part": (Part(2.0),),
    "span": ((0.1, 0.11),),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_a_range_takes_its_ends(name):
    for value in BOUNDS[name]:
        assert getattr(whole(**{name: value}), name) == value


@pytest.mark.parametrize("name", BOUNDS)
def test_what_lies_outside_is_refused_with_field_found_and_expected(name):
    hint, good = walk._hints(Whole)[name], getattr(whole(), name)
    tried = list(walk.impossible(hint, good))
    assert tried
    for bad in tried:
        with pytest.raises(InputError, match=rf"^Whole\.{name}: found .*, expected .+") as refusal:
            whole(**{name: bad})
        assert refusal.value.field == f"Whole.{name}"


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"count": 0}, "a whole number, 1 to 2147483647"),
        ({"seed": 10**19}, "a whole number, 0 to 4294967295"),
        ({"weight": -1.0}, "0 or more"),
        ({"place": math.nan}, "a finite number"),
        ({"timeout": 0.0}, "more than 0"),
        ({"share": 1.1}, "0 to 1"),
        ({"below": 4.0}, "at most 3"),
        ({"limit": 0.0}, "more than 0, or None"),
        ({"either": 0}, "one of auto, or a whole number, 1 to 2147483647"),
        ({"box": (1.0, -1.0)}, "of each: 0 or more"),
        ({"box": (1.0,)}, "2 values"),
        ({"layers": ()}, "1 or more"),
        ({"names": ("a", "a")}, "0 or more, each once"),
        ({"interval": (1.0, 0.0)}, "in ascending order"),
        ({"span": (0.1, 0.1)}, "different ones in ascending order"),
        ({"out": Path("x.txt")}, "a file name ending in .json or .csv"),
        ({"kind": "c"}, "one of a, b"),
        ({"on": 1}, "a bool"),
        ({"extra": [1]}, "a dict"),
        ({"part": {}}, "a Part"),
        ({"number": 101}, "at most 100 times count"),
    ],
)
def test_the_message_says_what_would_do(fields, expected):
    with pytest.raises(InputError) as refusal:
        whole(**fields)
    assert refusal.value.expected.endswith(expected)


def test_settings_of_a_command_are_named_as_its_flags():
    with pytest.raises(InputError, match=r"^--world-count: found 0, expected"):
        Command(world_count=0)


@dataclass(frozen=True)
class Own(Settings):
    far_off: Positive = 1.0
    near: Annotated[Positive, tyro.conf.arg(prefix_name=False)] = 1.0
    part: Part = field(default_factory=Part)


@dataclass(frozen=True)
class Once(Settings):
    speed: Positive = 1.0


@dataclass(frozen=True)
class Program(CommandSettings):
    own: Own = field(default_factory=Own)
    part: Part | Once = field(default_factory=Part)
    unnamed: Annotated[Command, tyro.conf.arg(name="")] = field(default_factory=lambda: Command(1))


@pytest.mark.parametrize(
    ("made", "flag"),
    [
        (lambda: Own(far_off=-1.0), "--own.far-off"),
        (lambda: Own(near=-1.0), "--near"),
        (lambda: Once(speed=-1.0), "--part.speed"),
        (lambda: Part(speed=-1), "Part.speed"),  # at two places
    ],
)
def test_settings_within_a_commands_are_named_as_flags_while_it_is_read(made, flag):
    with named_as_flags(Program), pytest.raises(InputError, match=f"^{flag}: found -1"):
        made()
    with pytest.raises(InputError, match=r"^(Own|Once|Part)\."):
        made()


def test_paths_are_shown_as_they_were_typed():
    with pytest.raises(InputError, match=r"found 'a b\.txt', expected"):
        whole(out=Path("a b.txt"))


def within(low, high, **options):
    return st.floats(low, high, allow_nan=False, allow_infinity=False, **options)


WHOLES = st.builds(
    whole,
    count=st.integers(1, 2**31 - 1),
    number=st.integers(0, 100),
    seed=st.integers(0, 2**32 - 1),
    place=within(None, None),
    weight=within(0, None),
    timeout=st.floats(0, exclude_min=True, allow_nan=False),
    limit=st.none() | within(0, None, exclude_min=True),
    either=st.just("auto") | st.integers(1, 100),
    layers=st.lists(st.integers(1, 9), min_size=1).map(tuple),
    names=st.lists(st.text(), unique=True).map(tuple),
    interval=st.tuples(within(None, None), within(None, None)).map(lambda x: tuple(sorted(x))),
    kind=st.sampled_from(["a", "b"]),
    on=st.booleans(),
    out=st.sampled_from([Path("a/b.json"), Path("/c.csv")]),
    part=st.builds(Part, speed=within(0, None, exclude_min=True), name=st.text()),
)


@given(WHOLES)
def test_settings_come_back_from_json_as_they_were(settings):
    text = json.dumps(to_record(settings), allow_nan=False)
    assert from_record(Whole, json.loads(text)) == settings


@pytest.mark.parametrize("never", ["inf", math.inf], ids=["today", "before"])
def test_what_never_ends_is_a_word_in_json_and_was_a_number_before(never):
    out = {"out": "a.json"}
    found = from_record(Whole, out | {"timeout": never, "kind": "a"})
    assert found.timeout == math.inf and found == Whole(Path("a.json"))
    with pytest.raises(InputError, match=r"timeout: found '?-inf"):
        from_record(Whole, out | {"timeout": "-inf"})
    with pytest.raises(InputError, match=r"name: found"):
        from_record(Part, {"name": math.inf})


@dataclass(frozen=True)
class Later(Settings):
    needed: Count
    old: Positive = 1.0
    new: Share = added(0.5, absent=1.0)
    part: Part = field(default_factory=Part)


def test_files_without_a_field_that_was_added_keep_what_it_was_then():
    assert Later(1).new == 0.5
    assert from_record(Later, {"needed": 2}) == Later(2, new=1.0)
    assert from_record(Later, {"needed": 2, "new": 0.25}).new == 0.25
    assert from_record(Later, {"needed": 2, "part": {"speed": 3}}).part == Part(3)


@pytest.mark.parametrize(
    ("record", "text"),
    [
        (
            {"needed": 1, "newer": 3, "also": 1},
            "config: found 'also, newer', expected some of needed, ",
        ),
        ({"old": 1.0}, r"config\.needed: found 'nothing', expected a value"),
        (
            {"needed": 1, "part": {"speeds": 1}},
            r"config\.part: found 'speeds', expected some of speed.* \(speed\?\)",
        ),
        (
            {"needed": 1, "part": None},
            r"config\.part: found None, expected a mapping of some of speed",
        ),
        ({"needed": 1, "part": {"speed": -1}}, r"config\.part\.speed: found -1, .*more than 0"),
        ({"needed": "1"}, r"config\.needed: found '1'"),
        ({"needed": 1.0}, r"config\.needed: found 1\.0"),
        ([], "config: found \\[\\], expected a mapping of some of needed, "),
        (None, "config: found None"),
    ],
)
def test_a_record_of_something_else_is_refused(record, text):
    with pytest.raises(InputError, match=text):
        from_record(Later, record, "config")


def test_paths_lists_and_missing_values_of_a_record_become_what_they_were():
    record = {"out": "a.json", "layers": [3, 4], "box": [2.0, 0.0], "limit": None}
    made = from_record(Whole, record)
    assert made == whole(out=Path("a.json"), layers=(3, 4), box=(2.0, 0.0))
    with pytest.raises(InputError, match=r"Whole\.box: .* expected 2 values"):
        from_record(Whole, record | {"box": [1.0, 2.0, 3.0]})
