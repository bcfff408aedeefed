"""The errors a user meets: each names the file or field, what was found and what was expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class MjxGraspError(Exception):
    """Base class of every error this package raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process: made anew from what it says and holds, not from its arguments."""
        return type(self).__new__, (type(self), *self.args), vars(self)


class InputError(MjxGraspError, ValueError):
    """A setting, name or argument that cannot work.

    Args:
        field: What was wrong: a configuration field, an argument, a name.
        found: What was given.
        expected: What would have been accepted.
    """

    def __init__(self, field: str, found: object, expected: str):
        self.field, self.found, self.expected = field, found, expected
        shown = str(found) if isinstance(found, Path) else found
        super().__init__(f"{field}: found {shown!r}, expected {expected}")


class FileError(MjxGraspError, ValueError):
    """A file that is missing, damaged, foreign or of the wrong content.

    Args:
        path: The file.
        found: What it holds or lacks.
        expected: What it should hold.
    """

    def __init__(self, path: str | Path, found: str, expected: str):
        self.path, self.found, self.expected = Path(path), found, expected
        super().__init__(f"{path}: found {found}, expected {expected}")
