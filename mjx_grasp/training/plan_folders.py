"""How far the trainings of a plan have come, by their folders."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

from mjx_grasp.errors import FileError
from mjx_grasp.learning.checkpoint import checkpoints
from mjx_grasp.records.atomic import read_json
from mjx_grasp.training.plan import Run
from mjx_grasp.training.start import START

COMMAND = ("python", "-m", "mjx_grasp.train")
"""What begins a training, before its flags."""


def finished(folder: Path | str) -> bool:
    """Whether a training has come to its end, its evaluation included."""
    return (Path(folder) / "finished.json").exists()


def check_begun(folder: Path, run: Run) -> None:
    """Refuses to go on with, or to count, what was begun with other flags.

    Raises:
        FileError: It was.
    """
    if not (finished(folder) or (folder / "provenance.json").exists()):
        return
    begun, asked = _flags_of(_begun_by(folder)), _flags_of(shlex.join(run.flags))
    if begun != asked:
        its, own = (" ".join(sorted(x)) or "no such flag" for x in (begun - asked, asked - begun))
        expected = f"{own}, as in the plan; name another --out, or delete the folder"
        raise FileError(folder, f"a training that was begun with {its}", expected)


def _begun_by(folder: Path) -> str:
    """The command that began a training, or its flags alone."""
    made = folder / "provenance.json"
    if made.exists():
        command = str(read_json(made, "the provenance of a training").get("command"))
        if command.startswith(shlex.join(COMMAND)):
            return command
    if not finished(folder):
        return ""
    # The first trainings of plans were said to be made by Ray.
    flags = read_json(folder / "finished.json", "flags of a training").get("flags", [])
    return shlex.join(map(str, flags))


def _flags_of(command: str) -> set[str]:
    """The flags of a command of `train`, each with its values; all but the folder."""
    _, *flags = f" {command}".split(" --")
    return {f"--{flag}" for flag in flags if not flag.startswith("out ")}


def stands_at(folder: Path) -> str:
    """What a training has come to: trainings that go on in step have to begin alike.

    What is left of one that was cut short while it was opened is removed.

    Raises:
        FileError: There is something else in its folder.
    """
    if not (folder / "provenance.json").exists():
        _clear(folder)  # cut short while it was opened
        return "not begun"
    kept = checkpoints(folder / "checkpoints")
    return kept[-1].name if kept else "begun"


def _clear(folder: Path) -> None:
    """Removes what was left of a training that had not begun.

    Raises:
        FileError: There is something else in its folder.
    """
    if not folder.exists():
        return
    opened = (START, "config.json", "handoffs", ".")
    if others := sorted(p.name for p in folder.iterdir() if not p.name.startswith(opened)):
        raise FileError(folder, f"{others[0]} and no training", "a training, or no such folder")
    shutil.rmtree(folder)
