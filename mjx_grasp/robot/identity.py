"""Which robot a file was made with: its name, and a digest of all that was known of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mjx_grasp.errors import FileError
from mjx_grasp.records.settings import Settings


@dataclass(frozen=True)
class RobotIdentity(Settings):
    """A robot as files name it."""

    name: str
    digest: str | None = None
    """SHA-256 of description and MJCF; None in files that do not say."""

    def agrees(self, other: RobotIdentity) -> bool:
        """Whether both may be one robot: by name alone where a digest is not known."""
        digests = {self.digest, other.digest} - {None}
        return self.name == other.name and len(digests) < 2

    def __str__(self) -> str:
        return f"{self.name} ({'unknown digest' if self.digest is None else self.digest[:12]})"


FIRST_ROBOT = RobotIdentity("rizon4_hx5d20")
"""The robot of files from before files named one: there was no other."""


def check_robot(path: str | Path, stored: RobotIdentity, used: RobotIdentity) -> None:
    """Refuses a file that was made with another robot.

    Args:
        path: The file.
        stored: The robot that it names.
        used: The robot in use.

    Raises:
        FileError: It is another robot, or the same with another description.
    """
    if not stored.agrees(used):
        raise FileError(path, f"the robot {stored}", str(used))
