"""`python -m mjx_grasp.train`: from objects to a trained policy, its evaluation and a report.

Picks its preset from the hardware: `gpu` trains on the eight objects in MJX, `cpu` on one object
in native MuJoCo within minutes; `paper` is the published setting.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import tyro
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.training.config import TrainConfig, preset_config, stored_config
from mjx_grasp.training.job import train
from mjx_grasp.viz.report import report_run


def parse(argv: list[str]) -> TrainConfig:
    """The configuration of a command line: the preset's, changed by the flags.

    A resumed run takes its stored configuration and nothing else.

    Raises:
        FileError: The run to resume has no configuration.
        InputError: Flags beside `--resume`, or an impossible setting.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="auto")
    first.add_argument("--resume", type=Path)
    known, others = first.parse_known_args(argv)
    if known.resume is not None:
        if others or known.preset != "auto":
            raise InputError("--resume", " ".join(argv), "no other flag: a run keeps its settings")
        return stored_config(known.resume)
    default = preset_config(known.preset)
    named = {flag.partition("=")[0] for flag in others}
    if "--ppo.worlds" in named:
        if "--fit-memory" in named:
            raise InputError("--fit-memory", "--ppo.worlds as well", "one of the two")
        default = replace(default, fit_memory=False)
    asked = replace(default, preset=known.preset)  # so that the help's default is auto, not cpu
    config = tyro.cli(TrainConfig, args=argv, default=asked, description=__doc__)
    return replace(config, preset=default.preset)


def main() -> None:
    """The command."""
    console, config = Console(stderr=True), parse(sys.argv[1:])
    folder = train(config, console)
    if config.evaluation_episodes:
        report_run(folder, console)


if __name__ == "__main__":
    run_command(main)
