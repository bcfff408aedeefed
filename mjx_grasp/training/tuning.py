"""Many trainings at once: a plan of settings, objects and seeds, run by Ray (extra `ray`)."""

from __future__ import annotations

import csv
import itertools
import os
import re
import shlex
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
import yaml
from rich.console import Console
from rich.table import Table

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.statistics import bootstrap_mean_interval
from mjx_grasp.learning.checkpoint import checkpoints
from mjx_grasp.records.atomic import check_new_folder, read_json, write_json
from mjx_grasp.records.cluster import connected
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, NonNegative, Positive, to_record
from mjx_grasp.records.spread import TRIES
from mjx_grasp.records.strict_yaml import load_yaml
from mjx_grasp.tasks.assemble import has_gpu
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.job import given_to, run_together

SCHEMA = "mjx_grasp.tune/1"
_COMMAND = ("python", "-m", "mjx_grasp.train")
_LAST = 20
"""Iterations whose mean stands for the end of a training."""
_OWN = ("out", "resume", "seed")
"""Flags of `train` that are not for a plan's settings."""
_PLAN = "a mapping with `seeds`, `settings` and, if wanted, `flags` and `objects`"


@dataclass(frozen=True)
class TuneConfig(CommandSettings):
    """Which trainings, where, and with how much of a machine each."""

    plan: tyro.conf.Positional[Path]
    """YAML: `settings` by name, each with flags of `train` and their values; `seeds`; if wanted,
    sets of `objects` by name, and `flags` that all have"""
    out: Path
    """folder of the runs and of their table; what is finished there is kept"""
    flags: str = ""
    """more flags of `train` for all of them, such as --flags="--objects-dir SCANS" """
    gpus: NonNegative | None = None
    """of each training, 0.5 for two on one; None: one where there is a GPU, none elsewhere [-]"""
    cpus: Positive = 1.0
    """cores of each training [-]"""
    together: bool = False
    """whether the seeds of a setting are one process, which takes one share and steps the worlds of
    all together: several times as fast where those of one do not fill a GPU; needs --handoffs"""
    address: str | None = None
    """of a Ray cluster, or `auto` for the one that this machine belongs to; None: this machine
    alone. The plan's paths and --out have to be the same on all its machines"""


class Run(NamedTuple):
    """One training of a plan."""

    name: str
    setting: str
    objects: str
    seed: int
    flags: tuple[str, ...]
    """of `train`"""


def read_plan(path: Path, more: str = "") -> list[Run]:
    """The trainings of a plan, every combination once.

    Args:
        path: The plan.
        more: Flags that all have beside its own.

    Raises:
        InputError: These are none, or stand in the plan.
        FileError: It is no plan, or two of its trainings have the same name.
    """
    try:
        content = _mapping("the plan", load_yaml(path.read_text()))
        known = {"flags", "settings", "objects", "seeds"}
        if unknown := sorted(set(content) - known):
            raise ValueError(f"unknown: {', '.join(unknown)}")
        common = _flags_in("flags", content.get("flags"))
        settings = {
            _part(name): _flags_in(name, of)
            for name, of in _mapping("settings", content.get("settings")).items()
        }
        asked = _mapping("objects", content.get("objects", {"": []}))
        objects = {_part(name): _listed(name, of) for name, of in asked.items()}
        seeds = _listed("seeds", content.get("seeds"))
        if wrong := [seed for seed in seeds if type(seed) is not int]:
            raise ValueError(f"seeds: {wrong[0]!r} is no whole number")
        if not (settings and objects and seeds) or len(set(seeds)) < len(seeds):
            raise ValueError("no settings, objects or seeds, or a seed twice")
        if any(objects.values()) and any("objects" in of for of in (common, *settings.values())):
            raise ValueError("objects both as a flag and as sets")
    except (OSError, yaml.YAMLError, ValueError) as error:
        said = " ".join(str(error).split())
        raise FileError(path, f"no plan ({said})", _PLAN) from None
    taken = {*common, *(flag for of in settings.values() for flag in of)}
    words = _more_flags(more, taken | ({"objects"} if any(objects.values()) else set()))
    runs = []
    for setting, group, seed in itertools.product(settings, objects, seeds):
        of = common | settings[setting] | {"seed": seed}
        if objects[group]:
            of |= {"objects": objects[group]}
        name = "-".join(part for part in (setting, group, f"seed{seed}") if part)
        runs.append(Run(name, setting, group, seed, (*as_flags(of), *words)))
    for name, count in Counter(run.name for run in runs).items():
        if count > 1:
            expected = "names of settings and objects that make one of their own for each"
            raise FileError(path, f"{count} trainings with the name {name}", expected)
    return runs


def _more_flags(more: str, taken: Collection[str]) -> list[str]:
    """Words of a command line, whose flags a plan does not have.

    Raises:
        InputError: They cannot be split, or a flag is the plan's.
    """
    try:
        words = shlex.split(more)
    except ValueError as error:
        raise InputError("--flags", more, f"words of a command line ({error})") from None
    for word in words:
        flag = word.partition("=")[0].removeprefix("--")
        if word.startswith("--") and (flag in taken or flag in _OWN):
            raise InputError("--flags", word, "flags that are not the plan's")
    return words


def _mapping(name: str, value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name}: {value!r} is no mapping")
    return value


def _flags_in(name: object, value: Any) -> dict[str, Any]:
    """Flags by the names that `train` has for them, without those that the plan itself decides."""
    flags = {}
    for flag, of in _mapping(str(name), {} if value is None else value).items():
        typed = str(flag).replace("_", "-")
        if typed in _OWN:
            raise ValueError(f"{name}: {flag}, which a plan decides itself")
        if typed in flags:
            raise ValueError(f"{name}: {typed} stands twice")
        flags[typed] = of
    return flags


def _part(name: object) -> str:
    """A part of the name of a training's folder."""
    if re.fullmatch(r"(\w[\w.+-]*)?", str(name)) is None:
        raise ValueError(f"{name!r} as a name: letters, digits and . + - _ alone")
    return str(name)


def _listed(name: object, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name}: {value!r} is no list")
    return value


def as_flags(values: Mapping[str, Any]) -> Iterator[str]:
    """Names and values of a plan as words of a command line."""
    for name, value in values.items():
        name = str(name).replace("_", "-")
        *parts, last = name.split(".")
        if value is False:
            yield "--" + ".".join((*parts, f"no-{last}"))
        elif value is True:
            yield f"--{name}"
        else:
            yield f"--{name}"
            yield from map(str, value if isinstance(value, list) else [value])


def tune(config: TuneConfig, console: Console) -> Table:
    """Runs what is not finished and gathers the table, which it also writes.

    Args:
        config: The settings.
        console: Where progress is shown.

    Raises:
        InputError: Ray is not installed, or a folder cannot be written.
        FileError: The plan is none, `train` refuses what it says, or the folder has a training that
            was begun with other flags.
        MjxGraspError: A training failed; the others are in the table.
    """
    if find_spec("ray") is None:
        raise InputError("tune", "no Ray", "the extra 'ray' (pip install 'mjx_grasp[ray]')")
    runs, made = read_plan(config.plan, config.flags), provenance(0)
    if not config.out.exists():
        check_new_folder("--out", config.out)
    for run in runs:
        _check_begun(config.out / run.name, run)
    left = [run for run in runs if not finished(config.out / run.name)]
    _check(config, left)
    table = config.out / "table.json"
    before, began = _before(table), time.monotonic()
    failed = run_all(config, left, console)
    rows = gathered(config.out, runs)
    content = {
        "schema": SCHEMA,
        "settings": to_record(config),
        "plan": load_yaml(config.plan.read_text()),
        "rows": rows,
        "took_s": before + time.monotonic() - began,
        "provenance": made,
    }
    write_json(table, content)
    if failed:
        said = "; ".join(f"{name}: {why}" for name, why in failed.items())
        raise MjxGraspError(f"{len(failed)} of {len(runs)} trainings failed: {said}")
    return shown(rows)


def _before(table: Path) -> float:
    """How long earlier calls of the same plan have worked on it [s]."""
    if not table.exists():
        return 0.0
    return read_json(table, "a table of trainings").get("took_s", 0.0)


def finished(folder: Path | str) -> bool:
    """Whether a training has come to its end, its evaluation included."""
    return (Path(folder) / "finished.json").exists()


def _check_begun(folder: Path, run: Run) -> None:
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
        if command.startswith(shlex.join(_COMMAND)):
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


def _check(config: TuneConfig, runs: Sequence[Run]) -> None:
    """Refuses what `train` would refuse, where it would run, before anything starts.

    Raises:
        FileError: It would.
    """
    if not runs:
        return
    for group in _groups(config, runs):
        named = [flag.partition("=")[0] for flag in group[0].flags]
        if len(group) > 1 and "--handoffs" not in named:
            raise InputError("--together", f"{group[0].setting} without --handoffs", "start states")
    work = [list(run.flags) for run in runs], os.getcwd()
    if config.address is None:
        said = refusals(*work)
    else:
        import ray

        with _tasks(config) as task:
            said = ray.get(task(refusals).remote(*work))
    for run, why in zip(runs, said, strict=True):
        if why:
            raise FileError(config.plan, f"{run.name}: {why}", "settings of `train`")


def refusals(trainings: Sequence[list[str]], cwd: str) -> list[str]:
    """Why `train` would refuse flags, as far as that is found out fast; else nothing."""
    os.chdir(cwd)
    return [_refusal(flags) for flags in trainings]


def _refusal(flags: list[str]) -> str:
    try:
        given_to(parse(flags))
    except MjxGraspError as error:
        return str(error)
    except SystemExit:  # of the parser, which has said why
        return f"no flags of `{shlex.join(_COMMAND)}` ({shlex.join(flags)})"
    return ""


@contextmanager
def _tasks(config: TuneConfig) -> Iterator[Callable[[Callable[..., Any]], Any]]:
    """What makes Ray tasks of functions, each with a training's share of a machine."""
    import ray

    with connected(config.address):
        gpus = config.gpus
        if gpus is None:
            alone = config.address is None
            gpus = float(has_gpu() if alone else ray.cluster_resources().get("GPU", 0) > 0)
        # A process of its own for each: what JAX holds goes with it. A lost one is run again.
        again = TRIES - 1
        yield ray.remote(max_calls=1, max_retries=again, num_cpus=config.cpus, num_gpus=gpus)


def run_all(
    config: TuneConfig,
    runs: Sequence[Run],
    console: Console,
    work: Callable[[list[str], list[list[str]], str], None] | None = None,
) -> dict[str, str]:
    """Runs them as Ray tasks; what failed, and why.

    Args:
        config: What each may take, and where they run.
        runs: Those that are not finished.
        console: Where progress is shown.
        work: What a task does, given folders, the flags of each, and working directory; by default
            `train`.
    """
    if not runs:
        return {}
    import ray

    with _tasks(config) as task:
        trained, out = task(work or train), config.out.resolve()
        begun = {}
        for group in _groups(config, runs):
            folders, flags = [str(out / run.name) for run in group], [list(r.flags) for r in group]
            begun[trained.remote(folders, flags, os.getcwd())] = group
        failed: dict[str, str] = {}
        with counting_progress(console) as bar:
            job = bar.add_task("trainings", total=len(runs))
            left = list(begun)
            while left:
                (done, *_), left = ray.wait(left, num_returns=1)
                try:
                    ray.get(done)
                except ray.exceptions.RayError as error:
                    why = str(error).strip().splitlines()[-1]
                    failed |= dict.fromkeys((run.name for run in begun[done]), why)
                bar.update(job, advance=len(begun[done]))
        return failed


def _groups(config: TuneConfig, runs: Sequence[Run]) -> list[list[Run]]:
    """The trainings of each process."""
    if not config.together:
        return [[run] for run in runs]
    alike: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        alike.setdefault((run.setting, run.objects), []).append(run)
    return list(alike.values())


def train(folders: list[str], flags: list[list[str]], cwd: str) -> None:
    """Trainings in a process of their own: from the start, or from where they were cut short."""
    os.chdir(cwd)
    wanted = [(Path(at), of) for at, of in zip(folders, flags, strict=True) if not finished(at)]
    groups: dict[str, list[tuple[Path, list[str]]]] = {}
    for at, of in wanted:
        groups.setdefault(_stands_at(at), []).append((at, of))
    failed: MjxGraspError | None = None
    for group in groups.values():
        try:
            _train_group(group)
        except MjxGraspError as error:
            failed = error  # the others are not to wait for it
    if failed is not None:
        raise failed


def _stands_at(folder: Path) -> str:
    """What a training has come to: trainings that go on in step have to begin alike."""
    if not (folder / "provenance.json").exists():
        _clear(folder)  # cut short while it was opened
        return "not begun"
    kept = checkpoints(folder / "checkpoints")
    return kept[-1].name if kept else "begun"


def _train_group(group: Sequence[tuple[Path, list[str]]]) -> None:
    """Trains in step."""
    words = [["--resume", str(at)] if at.exists() else [*of, "--out", str(at)] for at, of in group]
    shown = [
        [os.path.relpath(word) if word == str(at) else word for word in of]
        for of, (at, _) in zip(words, group, strict=True)
    ]
    commands = [shlex.join([*_COMMAND, *of]) for of in shown]
    with open(os.devnull, "w") as nowhere:
        run_together([parse(of) for of in words], Console(file=nowhere), commands=commands)
    for at, of in group:
        write_json(at / "finished.json", {"flags": of})


def _clear(folder: Path) -> None:
    """Removes what was left of a training that had not begun.

    Raises:
        FileError: There is something else in its folder.
    """
    if not folder.exists():
        return
    opened = ("config.json", "handoffs", ".")
    if others := sorted(p.name for p in folder.iterdir() if not p.name.startswith(opened)):
        raise FileError(folder, f"{others[0]} and no training", "a training, or no such folder")
    shutil.rmtree(folder)


def gathered(out: Path, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One row per finished training: how it ended, and what its evaluation says."""
    rows = []
    for run in runs:
        folder = out / run.name
        if not finished(folder):
            continue
        with (folder / "metrics.csv").open(newline="") as stream:
            last = list(csv.DictReader(stream))[-_LAST:]
        trained = {name: _mean(float(row[name]) for row in last) for name in ("success", "force_n")}
        row: dict[str, Any] = {
            "run": run.name,
            "setting": run.setting,
            "objects": run.objects,
            "seed": run.seed,
            "trained_percent": None if trained["success"] is None else 100 * trained["success"],
            "trained_force_n": trained["force_n"],
            "seconds": float(last[-1]["seconds"]),
        }
        results = folder / "results.json"
        if results.exists():
            rows_of = read_results(results).rows
            policy = [r for r in rows_of if r.controller == "policy" and r.label is None]
            row["evaluated_percent"] = _mean(100 * r.successes / r.episodes for r in policy)
            forces = (r.force_mean_n for r in policy if r.force_mean_n is not None)
            row["evaluated_force_n"] = _mean(forces)
        rows.append(row)
    return rows


def _mean(values: Iterator[float]) -> float | None:
    known = [x for x in values if x == x]
    return float(np.mean(known)) if known else None


def shown(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Mean over the seeds of each setting and set of objects, with a bootstrap interval."""
    columns = {
        "trained_percent": "trained %",
        "trained_force_n": "N",
        "evaluated_percent": "evaluated %",
        "evaluated_force_n": "N",
        "seconds": "s",
    }
    table = Table("setting", "objects", "seeds", *columns.values(), box=None)
    for setting, objects in dict.fromkeys((row["setting"], row["objects"]) for row in rows):
        of = [row for row in rows if (row["setting"], row["objects"]) == (setting, objects)]
        cells = []
        for name in columns:
            values = np.array([row[name] for row in of if row.get(name) is not None])
            text = f"{values.mean():.1f}" if len(values) else ""
            if len(values) > 1:
                low, high = bootstrap_mean_interval(values, seed=0)
                text += f" ({low:.1f}–{high:.1f})"
            cells.append(text)
        table.add_row(setting, objects, str(len(of)), *cells)
    return table
