"""Many trainings at once: what a plan names, run by Ray (extra `ray`)."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.records.atomic import check_new_folder, read_json, write_json
from mjx_grasp.records.cluster import connected
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, NonNegative, Positive, to_record
from mjx_grasp.records.spread import TRIES
from mjx_grasp.records.strict_yaml import load_yaml
from mjx_grasp.tasks.assemble import has_gpu
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.job import run_together
from mjx_grasp.training.plan import Run, read_plan
from mjx_grasp.training.plan_folders import COMMAND, check_begun, finished, stands_at
from mjx_grasp.training.plan_table import gathered, shown
from mjx_grasp.training.start import given_to

SCHEMA = "mjx_grasp.tune/1"


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
    check_new_folder("--out", config.out)
    table = config.out / "table.json"
    before, began = _before(table), time.monotonic()
    for run in runs:
        check_begun(config.out / run.name, run)
    left = [run for run in runs if not finished(config.out / run.name)]
    _check(config, left)
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
    kept = read_json(table, "a table of trainings")
    if kept.get("schema") != SCHEMA or not isinstance(kept.get("took_s"), int | float):
        raise FileError(table, f"schema {kept.get('schema')!r}", SCHEMA)
    return float(kept["took_s"])


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
        return f"no flags of `{shlex.join(COMMAND)}` ({shlex.join(flags)})"
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
        groups.setdefault(stands_at(at), []).append((at, of))
    failed: MjxGraspError | None = None
    for group in groups.values():
        try:
            _train_group(group)
        except MjxGraspError as error:
            failed = error  # the others are not to wait for it
    if failed is not None:
        raise failed


def _train_group(group: Sequence[tuple[Path, list[str]]]) -> None:
    """Trains in step."""
    words = [["--resume", str(at)] if at.exists() else [*of, "--out", str(at)] for at, of in group]
    shown = [
        [os.path.relpath(word) if word == str(at) else word for word in of]
        for of, (at, _) in zip(words, group, strict=True)
    ]
    commands = [shlex.join([*COMMAND, *of]) for of in shown]
    with open(os.devnull, "w") as nowhere:
        run_together([parse(of) for of in words], Console(file=nowhere), commands=commands)
    for at, of in group:
        write_json(at / "finished.json", {"flags": of})
