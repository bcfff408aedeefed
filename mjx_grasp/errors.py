"""The errors a user meets: each names the file or field, what was found and what was expected."""

from __future__ import annotations

from pathlib import Path


class MjxGraspError(Exception):
    """Base class of every error this package raises on purpose."""


class InputError(MjxGraspError, ValueError):
    """A setting, name or argument that cannot work.

    Args:
        field: What was wrong: a configuration field, an argument, a name.
        found: What was given.
        expected: What would have been accepted.
    """

    def __init__(self, field: str, found: object, expected: str):
        self.field, self.found, self.expected = field, found, expected
        super().__init__(field, found, expected)  # what another process makes it from

    def __str__(self) -> str:
        return f"{self.field}: found {self.found!r}, expected {self.expected}"


class FileError(MjxGraspError, ValueError):
    """A file that is missing, damaged, foreign or of the wrong content.

    Args:
        path: The file.
        found: What it holds or lacks.
        expected: What it should hold.
    """

    def __init__(self, path: str | Path, found: str, expected: str):
        self.path, self.found, self.expected = Path(path), found, expected
        super().__init__(path, found, expected)

    def __str__(self) -> str:
        return f"{self.path}: found {self.found}, expected {self.expected}"
