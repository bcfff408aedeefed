"""Settings with other values in some fields, by the paths of these."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import Any, TypeVar

S = TypeVar("S")


def changed(settings: S, path: str, value: Any) -> S:
    """Settings with another value in a field, or in a field of a field."""
    name, _, rest = path.partition(".")
    new: Any = settings
    return replace(new, **{name: changed(getattr(new, name), rest, value) if rest else value})


def value_of(settings: Any, path: str) -> Any:
    """What a field has, or a field of a field."""
    return reduce(getattr, path.split("."), settings)
