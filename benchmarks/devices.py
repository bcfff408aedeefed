"""Training on several GPUs of one host: steps per second, and whether it comes to its end.

Every setting is a training by the command itself, so what is timed is what a user gets: whole PPO
iterations with their log. A setting is DEVICESxWORLDS, worlds of each device, with @ITERATIONS and
a way to share the work where they differ from the default:

  2x4096             one process, the worlds split by `jax.shard_map`
  2x4096:processes   one process for each device, joined by `jax.distributed`
  2x4096:donate      one process whose state takes the memory of the one before (MuJoCo issue 2980)

Speeds are medians over the iterations after the first `--skip`; the first one is that with the
compilation. A training that does not end within `--limit-s` is stopped and said to hang. What is in
the file already, of the same settings and revision of the code, is left alone.

  python benchmarks/devices.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

import csv
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import check_writable, read_json, write_json
from mjx_grasp.records.journal import goes_on
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed, to_record

SCHEMA = "mjx_grasp.devices/1"
_SETTING = re.compile(r"(\d+)x(\d+)(?:@(\d+))?(?::(processes|donate))?")
_LAST = 20
"""Iterations whose mean stands for the end of a training."""


@dataclass(frozen=True)
class DevicesConfig(CommandSettings):
    """Which trainings to time."""

    out: Path
    settings: tuple[str, ...] = ("1x4096", "1x8192", "2x4096", "2x8192", "2x4096:processes",
                                 "2x8192:processes", "2x8192:donate")  # fmt: skip
    """DEVICESxWORLDS[@ITERATIONS][:processes|:donate], one after the other"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """handoff set; the one that goes with the objects by default"""
    preset: str = "gpu"
    """whose scene, task and PPO are trained"""
    flags: str = ""
    """more flags of `python -m mjx_grasp.train`, for every setting"""
    iterations: Count = 60
    """of each training, where the setting does not say [-]"""
    skip: Count = 10
    """of them that no speed is taken from [-]"""
    limit_s: Positive = 400.0
    """after which a training is said to hang [s]"""
    logs: Path | None = None
    """folder where what each training prints is kept"""
    seed: Seed = 0


class Setting(NamedTuple):
    """A training of the table."""

    name: str
    devices: int
    worlds: int
    """of each device"""
    iterations: int
    way: str
    """sharded, processes or donate"""


def setting_of(name: str, iterations: int) -> Setting:
    """What a word of `--settings` means.

    Raises:
        InputError: Nothing.
    """
    found = _SETTING.fullmatch(name)
    if found is None or 0 in (int(found[1]), int(found[2])):
        raise InputError("--settings", name, "DEVICESxWORLDS[@ITERATIONS][:processes|:donate]")
    devices, worlds = int(found[1]), int(found[2])
    return Setting(name, devices, worlds, int(found[3] or iterations), found[4] or "sharded")


def commands(setting: Setting, config: DevicesConfig, folder: Path) -> list[list[str]]:
    """The command of every process of a training."""
    several = setting.way == "processes"
    flags = {
        "--preset": config.preset,
        "--out": folder,
        "--seed": config.seed,
        "--objects-dir": config.objects_dir,
        "--handoffs": config.handoffs,
        "--devices": "auto" if several else setting.devices,
        "--ppo.worlds": setting.devices * setting.worlds,
        "--ppo.iterations": setting.iterations,
        "--loop.checkpoint-every": setting.iterations,
        "--evaluation-episodes": 0,
    }
    common = [str(x) for pair in flags.items() if pair[1] is not None for x in pair]
    command = [
        sys.executable,
        "-X",
        "faulthandler",
        "-m",
        "mjx_grasp.train",
        *common,
        *shlex.split(config.flags),
    ]
    if setting.way == "donate":
        command += ["--donate", "True"]
    if not several:
        return [command]
    with socket.socket() as opened:
        opened.bind(("localhost", 0))
        at = f"localhost:{opened.getsockname()[1]}"
    count = str(setting.devices)
    joined = [*command, "--coordinator", at, "--processes", count]
    return [[*joined, "--process", str(k)] for k in range(setting.devices)]


def trained(setting: Setting, config: DevicesConfig) -> dict[str, Any]:
    """Runs one training and reads what its log says."""
    with tempfile.TemporaryDirectory() as kept:
        folder, said = Path(kept) / "run", Path(kept) / "said"
        lines = commands(setting, config, folder)
        start = time.monotonic()
        with said.open("wb") as stream:
            running = [
                subprocess.Popen(line, stdout=stream, stderr=stream, env=_seeing(setting, k, lines))
                for k, line in enumerate(lines)
            ]
            outcome = _ended(running, start + config.limit_s)
        seconds = time.monotonic() - start
        if outcome == "failed":
            codes = ", ".join(str(process.returncode) for process in running)
            outcome = f"failed ({codes}): {said.read_text(errors='replace').strip()[-1500:]}"
        if config.logs is not None:
            config.logs.mkdir(parents=True, exist_ok=True)
            shutil.copy(said, config.logs / f"{setting.name}.log")
        path = folder / "metrics.csv"
        log = list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []
    return {**setting._asdict(), "outcome": outcome, "seconds": seconds} | measured(
        log, config.skip
    )


def _seeing(setting: Setting, process: int, lines: list[list[str]]) -> dict[str, str]:
    """The environment of a process, which sees its own GPUs alone."""
    count = setting.devices
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = given.split(",") if given else [str(k) for k in range(count)]
    own = names[:count] if len(lines) == 1 else [names[process]]
    return os.environ | {"CUDA_VISIBLE_DEVICES": ",".join(own)}


def _ended(running: list[subprocess.Popen], deadline: float) -> str:
    """How processes that depend on each other came to their end; none is left behind."""
    try:
        while any(p.poll() is None for p in running):
            if any(p.poll() for p in running):
                return "failed"
            if time.monotonic() > deadline:
                return "hung"
            time.sleep(0.2)
        return "failed" if any(p.returncode for p in running) else "finished"
    finally:
        for process in running:
            process.kill()
            process.wait()


def measured(log: list[dict[str, str]], skip: int) -> dict[str, Any]:
    """Speed and success of a training's log."""

    def mean(name: str) -> float | None:
        values = [float(row[name]) for row in log[-_LAST:]]
        known = [x for x in values if x == x]
        return float(np.mean(known)) if known else None

    speeds = [float(row["steps_per_s"]) for row in log[skip:]]
    return {
        "iterations_done": len(log),
        "env_steps": int(float(log[-1]["env_steps"])) if log else 0,
        "first_iteration_s": float(log[0]["seconds"]) if log else None,
        "steps_per_s": float(np.median(speeds)) if speeds else None,
        "steps_per_s_10_90": [float(x) for x in np.quantile(speeds, (0.1, 0.9))]
        if speeds
        else None,
        "success_percent": None if (share := mean("success")) is None else 100 * share,
        "force_n": mean("force_n"),
        "broken_worlds": sum(float(row["broken_worlds"]) for row in log),
        "overflows": sum(float(row["overflows"]) for row in log),
    }


def main(config: DevicesConfig) -> None:
    """Trains what is not there yet and writes the file after each."""
    check_writable("--out", config.out)
    asked = [setting_of(name, config.iterations) for name in config.settings]
    made = provenance(config.seed)
    same = to_record(config) | {"out": None, "settings": None, "logs": None}
    record: dict[str, Any] = {"schema": SCHEMA, "settings": same, "rows": [], "provenance": made}
    if config.out.exists():
        before = read_json(config.out, "speeds on several devices")
        again = goes_on(before, {"schema": SCHEMA, "settings": same}, made["git"])
        if again and before["provenance"]["device"] == made["device"]:
            record = before
    done = {row["name"] for row in record["rows"]}
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("trainings", total=len(asked))
        for setting in asked:
            if setting.name not in done:
                record["rows"].append(trained(setting, config))
                write_json(config.out, record)
                row = record["rows"][-1]
                print(setting.name, row["outcome"], row["steps_per_s"], flush=True)
            bar.update(job, advance=1)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(DevicesConfig, description=__doc__)), keeps=False)
