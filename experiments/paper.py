"""The publication's tables and figures, made again: one part each, with everything it needs.

  python experiments/paper.py --list
  python experiments/paper.py --objects-dir SCANS reach eight
  python experiments/paper.py --objects-dir SCANS
  python experiments/paper.py --objects-dir SCANS --quick

What is done for this revision of the code is not done again, so that a run that was stopped goes
on; several of the commands go on within themselves too. One that fails stops only those that need
what it makes. With a GPU some commands run beside each other, one in each of the lanes of
`lane_of`, and what they say goes to files. `--quick` is for a look at most of it. The last step,
once all is made, puts the numbers into the READMEs.
`docs/reproduction.md` says where each table and figure is shown.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import jax
import tyro
from paper_lanes import Step, in_lanes, steps_of
from paper_parts import CORES, FEWER, FOLDER, GRASPS, PARTS, SHARERS, TRIALS, Part, fewer
from rich.console import Console
from rich.table import Table

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluation.paper import EPISODES
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.provenance import (
    device_name,
    git_revision,
    is_committed,
    provenance,
    usable_cores,
)
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.tasks.assemble import has_gpu

ROOT = Path(__file__).resolve().parent.parent
SCHEMA = "mjx_grasp.paper/1"
LAST = "experiments/make_readme.py"
QUICKLY = 64
"""Trials of an object and condition with `--quick` [-]"""
_TRAIN = "mjx_grasp.train", "mjx_grasp.tune"
_IN_MJX = "--engine", "mjx"
_CORES_EACH = 2
"""Of processes that share a GPU: each compiles for minutes on one core, and then steps on all."""
_CORES_EACH_IN_MJX = 4
"""The same where the GPU steps too, which a few processes keep busy."""
_FOR_THE_GPU = 0.25
"""Share of the cores by which commands on all of them have fewer processes than there are."""
_SHARED = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""Environment in which no process takes the GPU's memory from others beside it."""


@dataclass(frozen=True)
class PaperConfig(CommandSettings):
    """Which parts to make."""

    parts: tyro.conf.Positional[tuple[str, ...]] = ()
    """by name; if none is named all but those that have to be, see `--list`"""
    quick: bool = False
    """only evaluations of the shipped policies, with fewer trials than published: closing in MJX on
    a GPU, which has to be there, whole grasps on the cores"""
    list: bool = False
    """only say what there is, and what of it is done"""
    objects_dir: Path | None = None
    """folder of real scans"""
    state: Path = ROOT / FOLDER / "state.json"
    """where what is done is noted, and how long it took"""


def chosen(names: tuple[str, ...]) -> list[Part]:
    """Parts by name, in their own order; without names all but those that have to be named.

    Raises:
        InputError: There is no such part.
    """
    known = [part.name for part in PARTS]
    for name in names:
        if name not in known:
            raise InputError("parts", name, f"some of {', '.join(known)}")
    return [part for part in PARTS if part.name in names or not (names or part.if_named)]


def left_out(part: Part, quick: bool) -> str | None:
    """Why a part is not made, None if it is."""
    if quick and part.not_quick:
        return f"is not made quickly: {part.not_quick}"
    return None if has_gpu() or not part.without_gpu else f"needs a GPU: {part.without_gpu}"


def quickened(part: Part) -> Part:
    """A part whose commands are those of `--quick`."""
    return replace(part, commands=tuple(fewer(command) for command in part.commands))


def machine() -> str:
    """What this runs on, in words."""
    device = jax.devices()[0]
    cores = "" if device.platform == "cpu" else f", {usable_cores()} cores"
    return f"{device_name(device)}{cores}"


def digest_of(scans: Path) -> str:
    """What tells a folder of scans from another one: its files, by name and size."""
    files = sorted(path for path in scans.rglob("*") if path.is_file())
    listed = [f"{path.relative_to(scans).as_posix()} {path.stat().st_size}" for path in files]
    return hashlib.sha256("\n".join(listed).encode()).hexdigest()


def done(state: dict[str, Any], command: str, scans: Path | None) -> bool:
    """Whether a command has ended well at this revision of the code, with these scans.

    With uncommitted changes nothing has, as the revision does not know them; nor has what lacks
    the file or folder that it made.
    """
    entry, git = state.get(command, {}), git_revision()
    same = scans is None or entry.get("scans") == digest_of(scans)
    return entry.get("git") == git and same and is_committed(git) and made_by(command).exists()


def made_by(command: str) -> Path:
    """What a command makes, as far as it says so by `--out`; else the repository."""
    words = shlex.split(command)
    return ROOT / words[words.index("--out") + 1] if "--out" in words else ROOT


def listed(parts: list[Part], state: dict[str, Any], scans: Path | None) -> Table:
    """What there is."""
    table = Table("part", "what of the publication", "commands done", "s, before", box=None)
    for part in parts:
        ready = sum(done(state, command, scans) for command in part.commands)
        before = [state[c]["seconds"] for c in part.commands if c in state]
        seconds = f"{sum(before):.0f}" if before else "?"
        notes = ["needs a GPU"] * bool(part.without_gpu) + ["not quick"] * bool(part.not_quick)
        notes += [f"only if named: {part.if_named}"] * bool(part.if_named)
        shown = part.shows + (f" ({', '.join(notes)})" if notes else "")
        table.add_row(part.name, shown, f"{ready} of {len(part.commands)}", seconds)
    return table


class Kept:
    """What is done, in a file.

    Args:
        path: The file, which need not be there yet.

    Raises:
        FileError: It is damaged, or of something else.
    """

    def __init__(self, path: Path) -> None:
        what = "the state of experiments/paper.py"
        kept = read_json(path, what) if path.exists() else {}
        if kept and kept.get("schema") != SCHEMA:
            raise FileError(path, f"schema {kept.get('schema')!r}", SCHEMA)
        self.path = path
        self.commands: dict[str, Any] = kept.get("commands", {})
        self.runs: list[dict[str, Any]] = kept.get("runs", [])
        whole = isinstance(self.commands, dict) and isinstance(self.runs, list)
        if not whole or not all(map(_is_note, [*self.commands.values(), *self.runs])):
            raise FileError(path, "commands or runs of another kind", f"{what}, undamaged")

    def begin(self, commands: Iterable[str]) -> None:
        """What is made again is not done, whatever comes of it, and in whatever form it was."""
        again = {fewer(command) for command in commands}
        self.commands = {c: entry for c, entry in self.commands.items() if fewer(c) not in again}
        self._write()

    def ended(self, command: str, scans: Path, seconds: float) -> None:
        """Notes a command."""
        self.commands[command] = {"scans": digest_of(scans), **_on_this_machine(seconds)}
        self._write()

    def all_ended(self, parts: Sequence[Part], quick: bool, seconds: float) -> None:
        """Notes how long several parts have taken together, in the place of what was noted of them.

        Args:
            parts: All of whose commands were made.
            quick: Whether with fewer trials.
            seconds: From the first command to the last one.
        """
        run = {"parts": [part.name for part in parts], "quick": quick}
        others = (one for one in self.runs if not run.items() <= one.items())
        self.runs = [*others, run | _on_this_machine(seconds)]
        self._write()

    def _write(self) -> None:
        record = {"commands": self.commands, "runs": self.runs, "provenance": provenance(seed=0)}
        write_json(self.path, {"schema": SCHEMA} | record)


def _is_note(noted: Any) -> bool:
    """Whether it says how long something took, as `_on_this_machine` does."""
    return isinstance(noted, dict) and isinstance(noted.get("seconds"), int | float)


def _on_this_machine(seconds: float) -> dict[str, Any]:
    return {"git": git_revision(), "seconds": round(seconds, 1), "machine": machine()}


def main(config: PaperConfig) -> None:
    """Makes what is not done."""
    console, kept = Console(stderr=True), Kept(config.state)
    names = config.parts or (tuple(part.name for part in PARTS) if config.list else ())
    parts = [quickened(part) if config.quick else part for part in chosen(names)]
    if config.list:
        Console().print(listed(parts, kept.commands, config.objects_dir))
        return
    if config.objects_dir is None or not config.objects_dir.is_dir():
        found = str(config.objects_dir) if config.objects_dir else "nothing"
        raise InputError("--objects-dir", found, "the folder of the scans")
    if config.quick and not has_gpu():
        raise InputError("--quick", "no GPU", "a GPU that MJX runs on")
    scans, possible = config.objects_dir, []
    for part in parts:
        if reason := left_out(part, config.quick):
            console.print(f"[yellow]{part.name} {reason}[/yellow]")
        else:
            possible.append(part)
    if not possible:
        raise InputError("parts", config.parts, "some that can be made here so")
    whole = {fewer(command): command for part in PARTS for command in part.commands}

    def is_left(command: str) -> bool:
        """What has been made in full is not made quickly in its place."""
        forms = {command, whole[command]} if config.quick else {command}
        return not any(done(kept.commands, form, scans) for form in forms)

    def stays(command: str) -> bool:
        """Full results stay with `--quick`, though what they were made from is made again."""
        full = whole.get(command, command)
        return full != command and done(kept.commands, full, scans)

    steps = [s for s in steps_of(possible, is_left, lane_of) if not stays(s.command)]
    made = frozenset(step.command for step in steps)
    steps = [step._replace(after=step.after & made) for step in steps]
    beside = len({step.lane for step in steps}) > 1
    began, writing, left = time.monotonic(), threading.Lock(), list(steps)
    before = kept.commands
    kept.begin(step.command for step in steps)
    failures: list[str] = []
    with counting_progress(console if beside else None) as bar:
        commands = bar.add_task("commands", total=len(steps))

        def make(step: Step) -> bool:
            number, started = steps.index(step) + 1, time.monotonic()
            with writing:
                spent = f"{(started - began) / 60:.0f} min so far{_guess(left, before)}"
            console.print(f"[bold]{number}/{len(steps)} {step.part}[/bold], {spent}")
            try:
                _run(step.command, scans, console, _log_of(step) if beside else None)
            except MjxGraspError as error:
                console.print(f"[red]{error}[/red]")
                failures.append(str(error))
                return False
            with writing:
                kept.ended(step.command, scans, time.monotonic() - started)
                left.remove(step)
            bar.update(commands, advance=1)
            return True

        lost = in_lanes(steps, make)
    if lost:
        goes_on = f"{len(lost)} of {len(steps)} commands are left; the same command goes on there"
        raise MjxGraspError("\n".join((*failures, goes_on)))
    if len(possible) > 1 and len(steps) == len({c for part in possible for c in part.commands}):
        kept.all_ended(possible, config.quick, time.monotonic() - began)
    _run(LAST, scans, console)


def _log_of(step: Step) -> Path:
    """Where a command's words go; the same file whatever else is left to do."""
    every = list(dict.fromkeys(fewer(command) for part in PARTS for command in part.commands))
    number = every.index(fewer(step.command)) + 1
    return ROOT / FOLDER / "logs" / f"{number:03d}-{step.part}.log"


def _guess(left: Sequence[Step], state: dict[str, Any]) -> str:
    """How long what is left takes, if all of it has been done before."""
    if any(step.command not in state for step in left):
        return ""
    of_lane: dict[str, float] = {}
    for step in left:
        of_lane[step.lane] = of_lane.get(step.lane, 0.0) + state[step.command]["seconds"]
    return f", about {max(of_lane.values(), default=0.0) / 60:.0f} min left"


def lane_of(command: str) -> str:
    """What a command keeps busy; without a GPU all share the cores.

    What is timed on the GPU, trainings and all, has no neighbour there; and what is not takes as
    long beside another as the two take one after the other.
    """
    on_gpu = TRIALS, FEWER, GRASPS, SHARERS, " ".join(_IN_MJX), *_TRAIN
    if has_gpu() and any(word in command for word in on_gpu):
        return "the GPU"
    return CORES if CORES in command or not has_gpu() else "one process"


def going_on(words: list[str]) -> list[str]:
    """A command, or of a training that was stopped the one that goes on with it.

    A run by another command or revision of the code stays, under another name.
    """
    if words[:2] != ["-m", "mjx_grasp.train"]:
        return words
    folder = ROOT / words[words.index("--out") + 1]
    if not (folder / "config.json").exists():
        return words
    begun = folder / "provenance.json"
    made = read_json(begun, "the provenance of a run") if begun.exists() else {}
    git = git_revision()
    same = made.get("command") == shlex.join(["python", *words]) and made.get("git") == git
    if same and is_committed(git):
        return [*words[:2], "--resume", os.path.relpath(folder, ROOT)]
    names = (folder.with_name(f"{folder.name}.before-{k}") for k in count(1))
    folder.rename(next(name for name in names if not name.exists()))
    return words


def worded(command: str, scans: Path) -> list[str]:
    """A command as it is typed on this machine, without Python's name."""
    cores, gpu = usable_cores(), has_gpu()
    sharers = max(1, cores // _CORES_EACH) if gpu else cores
    there = os.path.relpath(scans, ROOT)  # results keep the command
    own = max(1, round(cores * (1.0 - _FOR_THE_GPU))) if gpu else cores
    given = {"SCANS": there, CORES: str(own), SHARERS: str(sharers)}
    words = []
    for word in shlex.split(command):
        kind, _, trials = word.partition(":")
        if word == GRASPS:
            beside = max(1, cores // _CORES_EACH_IN_MJX) if gpu else cores
            words += [*(_IN_MJX if gpu else ()), "--processes", str(beside)]
        elif f"{kind}:" not in (TRIALS, FEWER):
            word = re.sub(r"^(\d+)\|\d+$", r"\1", word)
            parts = word.split(" ")  # of a word with spaces, words that are split once more
            told = [given.get(part, part) for part in parts]
            words.append(told[0] if len(parts) == 1 else " ".join(map(_again, parts, told)))
        elif gpu:
            trials = str(QUICKLY if f"{kind}:" == FEWER else EPISODES)
            words += [*_IN_MJX, "--episodes", trials]
        else:
            words += ["--episodes", trials, "--processes", str(cores)]
    return words


def _again(part: str, told: str) -> str:
    """A word within a word: what is put in for another stays whole."""
    return told if told == part else shlex.quote(told)


def _more_environment(command: str) -> dict[str, str]:
    """What a command's own environment has beside this one's."""
    if CORES in command:  # processes that share all cores would only wait for each other on a GPU
        return {"JAX_PLATFORMS": "cpu"}
    if any(trains in command for trains in _TRAIN) or not has_gpu():
        return {}
    # Kernels are not tried out for each function: only trainings run long enough to gain that back.
    own = os.environ.get("XLA_FLAGS", "")  # of two flags the later one counts
    return {"XLA_FLAGS": f"--xla_gpu_autotune_level=0 {own}".strip()}


def _run(command: str, scans: Path, console: Console, log: Path | None = None) -> None:
    """Runs a command of this repository in its root.

    Args:
        command: As in a part.
        scans: Their folder.
        console: For the command as it is typed.
        log: Where what it says goes; None: to where this process says things.

    Raises:
        MjxGraspError: It failed.
    """
    words = going_on(worded(command, scans))
    console.print(f"[dim]python {shlex.join(words)}[/dim]")
    (ROOT / FOLDER / "logs").mkdir(parents=True, exist_ok=True)  # commands write there
    env = os.environ | _SHARED | _more_environment(command)
    with log.open("w") if log else nullcontext() as out:
        code = subprocess.run(
            [sys.executable, *words], cwd=ROOT, env=env, check=False, stdout=out, stderr=out
        ).returncode
    if code:
        said = f"; {log} has what it said" if log else ""
        raise MjxGraspError(f"python {shlex.join(words)}: ended with {code}{said}")


if __name__ == "__main__":
    os.environ.update(_SHARED)
    run_command(lambda: main(tyro.cli(PaperConfig, description=__doc__)))
