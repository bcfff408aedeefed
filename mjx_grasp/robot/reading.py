"""Typed reading of a YAML description, with errors that name the file and the field."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from mjx_grasp.errors import FileError, InputError


class Section:
    """A mapping of a description file, from which every key must be taken exactly once.

    Args:
        path: The file.
        content: The mapping.
        where: Dotted name of the mapping inside the file; empty at the top.
    """

    def __init__(self, path: Path, content: Any, where: str = ""):
        self.path, self.where = path, where
        if not isinstance(content, Mapping):
            raise InputError(self.field(), content, "a mapping of keys to values")
        self._content = dict(content)
        self._taken: set[str] = set()

    @classmethod
    def from_file(cls, path: Path) -> Section:
        """The whole file as a section.

        Raises:
            FileError: The file is missing or not YAML.
        """
        try:
            content = yaml.safe_load(path.read_text())
        except OSError as error:
            raise FileError(path, error.strerror or "no file", "a robot description") from error
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            found = " ".join(str(error).split())
            raise FileError(path, f"no valid YAML ({found})", "a robot description") from error
        return cls(path, content)

    def field(self, key: str = "") -> str:
        """File and dotted name of a key, for messages."""
        return f"{self.path}: " + (
            ".".join(part for part in (self.where, key) if part) or "content"
        )

    def _take(self, key: str) -> Any:
        if key not in self._content:
            raise InputError(self.field(key), "nothing", "this key to be present")
        self._taken.add(key)
        return self._content[key]

    def _name(self, value: Any, field: str) -> str:
        if not isinstance(value, str) or not value:
            raise InputError(field, value, "a name")
        return value

    def _number(self, value: Any, field: str) -> float:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            raise InputError(field, value, "a finite number")
        return float(value)

    def name(self, key: str, among: tuple[str, ...] = ()) -> str:
        """A non-empty string; one of ``among``, if given."""
        value = self._name(self._take(key), self.field(key))
        if among and value not in among:
            raise InputError(self.field(key), value, "one of " + ", ".join(among))
        return value

    def names(self, key: str) -> tuple[str, ...]:
        """A list of distinct, non-empty strings, at least one."""
        value = self._list(key)
        names = tuple(self._name(v, f"{self.field(key)}[{i}]") for i, v in enumerate(value))
        if not names:
            raise InputError(self.field(key), value, "at least one name")
        if len(set(names)) != len(names):
            raise InputError(self.field(key), names, "each name once")
        return names

    def number(self, key: str, positive: bool = False) -> float:
        """A finite number; above zero, if asked."""
        value = self._number(self._take(key), self.field(key))
        if positive and value <= 0:
            raise InputError(self.field(key), value, "a number above zero")
        return value

    def numbers(self, key: str, length: int) -> tuple[float, ...]:
        """A list of that many finite numbers."""
        value = self._list(key)
        if len(value) != length:
            raise InputError(self.field(key), f"{len(value)} numbers", f"{length} numbers")
        return tuple(self._number(v, f"{self.field(key)}[{i}]") for i, v in enumerate(value))

    def _list(self, key: str) -> list[Any]:
        value = self._take(key)
        if not isinstance(value, list):
            raise InputError(self.field(key), value, "a list")
        return value

    def section(self, key: str) -> Section:
        """The mapping under a key."""
        return Section(self.path, self._take(key), ".".join(p for p in (self.where, key) if p))

    def sections(self, key: str) -> list[Section]:
        """The mappings of a list under a key."""
        where = ".".join(part for part in (self.where, key) if part)
        return [Section(self.path, v, f"{where}[{i}]") for i, v in enumerate(self._list(key))]

    def as_json(self) -> str:
        """The mapping in one spelling, whatever its comments and the order of its keys."""
        return json.dumps(self._content, sort_keys=True)

    def done(self) -> None:
        """Refuses keys that nobody took: a misspelt key must not be ignored.

        Raises:
            InputError: There is such a key.
        """
        if unknown := sorted(str(key) for key in self._content if key not in self._taken):
            raise InputError(
                self.field(), ", ".join(unknown), "only the keys " + ", ".join(sorted(self._taken))
            )
