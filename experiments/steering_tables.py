"""Tables of steering for the READMEs, from the results of `steering_numbers.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markdown_tables import NOTHING, markdown, read

from mjx_grasp.records.table import Table

_DEFAULT = "default"
ON_TABLE_MM = 15.0
"""A place nearer to the table lies on it: no fingertip fits between."""
_NEAREST = ("nearest_mm", "nearest_easy_mm")
_APART = ("first_mm", "chosen_mm", "achieved_mm")
_COMPARED = (("chosen_mm", "nearest_easy_mm"), *((at, at) for at in _APART))
"""Of a default grasp, and of the steered one from the same pose."""
_ALIKE_MM = 2.0
"""Contacts that are farther by less are as near."""
Places = list[dict[str, dict[str, Any]]]
"""Of each place the rows by the way of steering."""


def steering(path: Path) -> str:
    """Of sides and of parts: distances to the anchor, and how many are nearer than by default."""
    d = read(path)
    if d is None:
        return NOTHING
    places = _places(d["rows"])
    groups = (
        ("parts", [p for p in places if _first(p)["kind"] == "part"]),
        ("sides", [p for p in places if _is_side(p, held_out=False)]),
        ("sides, held out", [p for p in places if _is_side(p, held_out=True)]),
        ("all", places),
    )
    rows = [
        (name, f"{len(of)}", way, *_summary(of, way)) for name, of in groups if of for way in of[0]
    ]
    header = (
        "places",
        "of them",
        "steering",
        "contacts mm",
        "nearer %",
        "on part %",
        "choice %",
        "quality",
    )
    objects = len({_first(p)["object"] for p in places})
    nearest = [f for p in places if (f := _first(p)["nearest_mm"]) is not None]
    least = d["settings"]["usable"]
    return (
        f"{markdown(Table('Steering', header, tuple(rows), names=3))}\n\n"
        f"{len(places)} places on {objects} object{'s' * (objects > 1)}. The distance of the three "
        "contacts from the anchor is their mean, and of it and of the quality (the score without "
        "its centre-of-mass term) the median is shown; *nearer* are the places with contacts "
        "nearer than by default, *on part* the parts with all three contacts on them, "
        "*choice* how much of what a whole grasp chooses among lies on the part. Without "
        f"regard to anything else, the nearest candidates with a score of {least:g} are at "
        f"{np.median(nearest):.1f} mm by the median: two contacts on opposite sides of an object "
        "cannot both be near the middle of a third."
    )


def parts(path: Path) -> str:
    """Of every named part: distance to its middle, and how far outside it the contacts lie."""
    d = read(path)
    if d is None:
        return NOTHING
    named = [p for p in _places(d["rows"]) if _first(p)["kind"] == "part"]
    rows = tuple(
        (
            _first(p)["object"].replace("_", " "),
            _first(p)["place"],
            _first(p)["mesh"],
            *(f"{row['contacts_mm']:.0f} / {max(row['outside_mm']):.0f}" for row in p.values()),
            f"{p['contacts']['quality']:.2f}",
        )
        for p in named
    )
    ways = tuple(named[0]) if named else ()
    return markdown(Table("Parts", ("object", "part", "mesh", *ways, "quality"), rows, names=3))


def executed(path: Path) -> str:
    """Whole grasps with and without steering: how near they come, what it costs."""
    d = read(path)
    if d is None:
        return NOTHING
    ways = list(dict.fromkeys(row["steering"] for row in d["rows"]))
    groups: dict[str, Callable[[dict[str, Any]], bool]] = {
        "parts": lambda row: row["kind"] == "part",
        "sides": lambda row: row["kind"] == "side",
        "all": lambda row: True,
        "all that do not lie on the table": lambda row: row["height_mm"] >= ON_TABLE_MM,
    }
    lines = []
    for name, counts in groups.items():
        of = {way: [r for r in d["rows"] if r["steering"] == way and counts(r)] for way in ways}
        pairs = list(zip(*of.values(), strict=True))
        if not pairs:
            continue
        for way, rows in of.items():
            held = sum(row["outcome"] == "success" for row in rows)
            apart = (_median([row[at] for row in rows]) for at in (*_NEAREST, *_APART))
            lines.append(
                (
                    name,
                    f"{len(rows)}",
                    way,
                    *apart,
                    *("" if way == ways[0] else _compared(pairs, *at) for at in _COMPARED),
                    f"{100 * held / len(rows):.1f}",
                    _median([row["force_mean_n"] for row in rows]),
                )
            )
    header = (
        *("places", "grasps", "steering", "nearest mm", "nearest easy mm"),
        *("first mm", "last mm", "achieved mm", "could be nearer %"),
        *("first nearer / farther %", "last nearer / farther %", "achieved nearer / farther %"),
        *("lifted and held %", "force N"),
    )
    return markdown(Table("Steered grasps", header, tuple(lines), names=3))


def _compared(pairs: Sequence[Sequence[dict[str, Any]]], default: str, steered: str) -> str:
    """In how many pairs the second is nearer, of those in which both come so far [%].

    Where it is about the same contacts of both, also in how many it is clearly farther.
    """
    apart = ((a[default], b[steered]) for a, b in pairs)
    both = [(a, b) for a, b in apart if a is not None and b is not None]
    if not both:
        return ""
    nearer = f"{100 * np.mean([b < a for a, b in both]):.0f}"
    farther = f"{100 * np.mean([b > a + _ALIKE_MM for a, b in both]):.0f}"
    return f"{nearer} / {farther}" if default == steered else nearer


def _median(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.1f}" if known else ""


def _places(rows: Sequence[dict[str, Any]]) -> Places:
    found: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["object"], row["place"]), {})[row["steering"]] = row
    return list(found.values())


def _summary(places: Places, way: str) -> tuple[str, ...]:
    apart = np.array([p[way]["contacts_mm"] for p in places])
    default = np.array([p[_DEFAULT]["contacts_mm"] for p in places])
    on = [p[way]["on_part"] for p in places if p[way]["on_part"] is not None]
    choice = [p[way]["choice_on_part"] for p in places if p[way]["on_part"] is not None]
    quality = np.median([p[way]["quality"] for p in places])
    nearer = "" if way == _DEFAULT else f"{100 * np.mean(apart < default):.1f}"
    shares = (f"{100 * np.mean(of):.1f}" if of else "" for of in (on, choice))
    return f"{np.median(apart):.1f}", nearer, *shares, f"{quality:.2f}"


def _is_side(place: dict[str, dict[str, Any]], held_out: bool) -> bool:
    row = _first(place)
    return row["kind"] == "side" and (row["split"] == "held_out") is held_out


def _first(place: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return place[_DEFAULT]
