"""Times `make train` from a fresh clone: a newcomer's first minutes.

  python experiments/time_make_train.py --clone /tmp/fresh

clones this repository's last commit, runs `make setup` and `make train` there, and writes how long
they took, what the return did and what the evaluation found to
`experiments/results/make_train_cpu.json`. The clone stays, with the run's report in it.
Nothing else should run meanwhile.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from mjx_grasp.cli import run_command
from mjx_grasp.compiled import VARIABLE
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import check_writable, read_json, replacing
from mjx_grasp.records.provenance import command_line
from mjx_grasp.records.settings import CommandSettings

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class TimeConfig(CommandSettings):
    """Where to clone to and where to write."""

    clone: Path
    """folder to make; it must not be there"""
    python: str = "python3"
    """the Python that `make` is given"""
    out: Path = ROOT / "experiments" / "results" / "make_train_cpu.json"
    """results file"""


def timed(command: list[str], folder: Path | None = None) -> float:
    """Runs a command and returns its wall-clock time [s].

    Raises:
        InputError: It failed.
    """
    began = time.perf_counter()
    code = subprocess.run(command, cwd=folder, check=False).returncode
    if code != 0:
        raise InputError("command", " ".join(command), f"to succeed; it returned {code}")
    return time.perf_counter() - began


def fresh_clone(folder: Path, python: str) -> float:
    """Clones the last commit, makes its environment, and returns how long the latter took [s].

    Args:
        folder: Where to; it must not be there.
        python: The Python of the environment.

    Raises:
        InputError: The folder is there, or a command failed.
    """
    if folder.exists():
        raise InputError("--clone", str(folder), "a folder that is not there yet")
    timed(["git", "clone", "--quiet", str(ROOT), str(folder)])
    return timed(["make", "setup", f"PYTHON={python}"], folder)


def curve(path: Path) -> dict[str, float]:
    """Return and success at both ends of a training, each a mean over a tenth of its iterations.

    Iterations in which no episode ended, such as the first ones, say nothing of either.

    Raises:
        FileError: Too few iterations to say.
    """
    with path.open(newline="") as stream:
        iterations = list(csv.DictReader(stream))
    rows = [r for r in iterations if np.isfinite(float(r["return"]))]
    tenth = len(rows) // 10
    if tenth == 0:
        raise FileError(path, f"{len(rows)} iterations with episodes", "ten or more")

    def mean(name: str, part: list[dict[str, str]]) -> float:
        return float(np.mean([float(r[name]) for r in part]))

    return {
        "iterations": len(iterations),
        "env_steps": int(float(iterations[-1]["env_steps"])),
        "training_s": float(iterations[-1]["seconds"]),
        "return_first_tenth": mean("return", rows[:tenth]),
        "return_last_tenth": mean("return", rows[-tenth:]),
        "success_first_tenth_percent": 100 * mean("success", rows[:tenth]),
        "success_last_tenth_percent": 100 * mean("success", rows[-tenth:]),
    }


def write(out: Path, run: Path, durations: dict[str, float]) -> None:
    """The results file of a run and how long what took."""
    results = read_json(run / "results.json", "a results file")
    document = {
        "schema": results["schema"],
        "label": results["label"],
        **{name: results[name] for name in ("untrained_n",) if name in results},
        "make_train": durations | curve(run / "metrics.csv"),
        "rows": results["rows"],
        "provenance": results["provenance"] | {"command": command_line()},
    }
    with replacing(out) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def main(config: TimeConfig) -> None:
    """Clones, runs, and writes the results file."""
    check_writable("--out", config.out)
    setup_s = fresh_clone(config.clone, config.python)
    # As on a new machine: nothing that was compiled before is there.
    os.environ[VARIABLE] = str(config.clone.resolve() / ".cache" / "compiled")
    train_s = timed(["make", "train"], config.clone)
    (run,) = (config.clone / "runs").iterdir()
    durations = {"setup_s": setup_s, "train_s": train_s, "total_s": setup_s + train_s}
    write(config.out, run, durations)
    print(f"{durations['total_s'] / 60:.1f} min; {run / 'report.html'}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(TimeConfig, description=__doc__)))
