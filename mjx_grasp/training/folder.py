"""The folder of a run: found or refused, opened, compared when resumed, noted in, taken back."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mjx_grasp.errors import FileError
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.records.atomic import check_new_folder, copy_file, read_json, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.training.config import TrainConfig
from mjx_grasp.training.start import START, handoffs_wanted, start_file

_CONFIG, _PROVENANCE = "config.json", "provenance.json"
"""Files that are written when a run is opened."""
_OF_A_RUN = "handoffs.npz", "policy.npz", "metrics.csv", "checkpoints", _PROVENANCE, START
"""Files that a run that was opened would read or write over."""


def run_folder(config: TrainConfig) -> Path:
    """The run's folder: that of the run to resume, or one that can be made.

    Raises:
        FileError: There is a run in it already, or a file that one would read or write over.
        InputError: Nothing can be written there.
    """
    if config.resume is not None:
        return config.resume
    folder = config.out or Path("runs") / f"{config.preset}-{time.strftime('%Y%m%d-%H%M%S')}"
    if (folder / "config.json").exists():
        raise FileError(
            folder, "a run that is already there", f"another --out, or --resume {folder}"
        )
    others = [name for name in _OF_A_RUN if (folder / name).exists()]
    if others:
        raise FileError(folder, f"{others[0]}, of no run", "another --out")
    check_new_folder("--out", folder)
    return folder


def check_same_files(config: TrainConfig) -> None:
    """Refuses to resume with other start states, or another policy, than the run began with.

    Raises:
        FileError: A file has changed since, or the run's provenance cannot be read.
    """
    if config.resume is None:
        return
    path, made_of = config.resume / "provenance.json", _began_with(config.resume)
    given = {"handoffs": config.handoffs, "start_from": start_file(config)}
    for name, digest in file_digests(**given).items():
        if digest != made_of.get(name, digest):
            what = f"the file that {config.resume} began with (SHA-256 {made_of[name][:12]})"
            found = f"a changed file (SHA-256 {digest[:12]})"
            raise FileError(given[name] or path, found, what)


def _began_with(folder: Path) -> dict[str, str]:
    """Digests of the files that a run began with."""
    path, expected = folder / "provenance.json", "the provenance of the run to resume"
    made_of = read_json(path, expected).get("sha256", {})
    if not (isinstance(made_of, dict) and all(isinstance(x, str) for x in made_of.values())):
        raise FileError(path, f"sha256 = {made_of!r}", expected)
    return made_of


def as_begun(config: TrainConfig, shipped: Path | None) -> Path | None:
    """The shipped set that a run copies; a run that is resumed, only the one that it began with.

    Args:
        config: The run's.
        shipped: The set that would do.

    Raises:
        FileError: It began with another, and has no copy of it yet.
    """
    if config.resume is None:
        return shipped
    began = _began_with(config.resume).get("shipped_handoffs")
    if began is None or (config.resume / "handoffs.npz").exists():
        return None
    if shipped is None or file_digests(shipped=shipped)["shipped"] != began:
        found = f"no copy of the start states that it began with (SHA-256 {began[:12]})"
        raise FileError(config.resume, found, "a run that has one: other states ship now")
    return shipped


def check_same_terms(config: TrainConfig, extra_terms: Sequence[RewardTerm]) -> None:
    """Refuses to resume without the extra reward terms of the run, or with others.

    Args:
        config: The run's.
        extra_terms: Those that are given now.

    Raises:
        FileError: The terms differ, or the run's provenance cannot be read.
    """
    if config.resume is None:
        return
    path = config.resume / "provenance.json"
    began = read_json(path, "the provenance of the run to resume").get("extra_terms", [])
    given = [term.name for term in extra_terms]
    if given != began:
        expected = f"{began}, as the run was begun with: resume it from the script that gave them"
        raise FileError(path, f"extra reward terms {given} now", expected)


def open_run(
    config: TrainConfig,
    folder: Path,
    stored: HandoffSet | None,
    shipped: Path | None,
    command: str | None,
    extra_terms: Sequence[RewardTerm],
) -> None:
    """Writes the configuration and the provenance of a new run to its folder.

    Args:
        config: The run's.
        folder: From `run_folder`.
        stored: Start states that are given; None where they are made, or copied.
        shipped: The shipped set that is copied, if one is.
        command: What the files say they were made by; by default what started this process.
        extra_terms: Reward terms beside the task's own, of which the names are kept.

    Raises:
        FileError: Another run has been opened there meanwhile.
    """
    begun_with = start_file(config)
    files = {"handoffs": config.handoffs, "shipped_handoffs": shipped}
    digests = file_digests(**files, start_from=begun_with)
    made_of: dict[str, Any] = {"sha256": digests}
    made_of["extra_terms"] = [term.name for term in extra_terms]
    kind: str
    if stored is None:
        kind, wanted = config.handoffs_kind, config.handoffs_per_object
        reached = handoffs_wanted(config, folder).shares(wanted)[1] / wanted
    else:
        kind, reached = stored.kind, float(stored.reached.mean()) if len(stored) else 0.0
    made_of["handoffs"] = {"kind": kind, "reached_share": round(reached, 4)}
    made = provenance(config.seed, command) | made_of
    try:
        write_json(folder / _CONFIG, to_record(config), new=True)
    except FileExistsError:
        found = "a run that was begun there at the same time"
        raise FileError(folder, found, "another --out") from None
    try:
        if begun_with is not None:  # a later version of the package ships another
            copy_file(begun_with, folder / START)
        write_json(folder / _PROVENANCE, made)
    except BaseException:
        discard_run(folder)
        raise


def note_resumed(folder: Path, made: dict[str, Any]) -> None:
    """Adds to a run's provenance what goes on with it, where that is not what began it.

    Args:
        folder: The run.
        made: The provenance of what goes on.

    Raises:
        FileError: The run's provenance cannot be read.
    """
    path = folder / "provenance.json"
    expected = "the provenance of the run to resume"
    began = read_json(path, expected)
    resumed = began.get("resumed", [])
    if not isinstance(resumed, list) or not all(isinstance(each, dict) for each in resumed):
        raise FileError(path, f"resumed = {resumed!r}", expected)
    last = resumed[-1] if resumed else began
    if any(made[name] != last.get(name) for name in ("git", "versions", "device")):
        write_json(path, began | {"resumed": [*resumed, made]})


def discard_run(folder: Path) -> None:
    """Takes back what `open_run` wrote, for a run that cannot begin."""
    for name in (START, _PROVENANCE, _CONFIG):  # which says last that the folder is taken
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # there is more in it, or it is a link
        folder.rmdir()
