"""What a training is asked for: a preset and changes to it, or a run to resume."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import tyro

from mjx_grasp.errors import InputError
from mjx_grasp.learning.devices import RunOn, join_hosts
from mjx_grasp.records.command_line import parsed
from mjx_grasp.training.config import TrainConfig, preset_config, stored_config


def parse(argv: list[str], description: str | None = None) -> TrainConfig:
    """The configuration of a command line: the preset's, changed by the flags.

    A resumed run takes its stored configuration and nothing else but where it runs. With a
    coordinator the processes meet here, before anything asks JAX for its devices.

    Args:
        argv: What follows the command's name.
        description: For the help.

    Raises:
        FileError: The run to resume has no configuration.
        InputError: Flags beside `--resume`, processes that do not meet, or an impossible setting.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="auto")
    first.add_argument("--resume", type=Path)
    known, others = first.parse_known_args(argv)
    run_on, rest = tyro.cli(RunOn, args=others, return_unknown_args=True, add_help=False)
    join_hosts(run_on)
    if known.resume is not None:
        if rest or known.preset != "auto":
            expected = "no other flag but those of devices: a run keeps its settings"
            raise InputError("--resume", " ".join(argv), expected)
        return replace(stored_config(known.resume), run_on=run_on)
    default = preset_config(known.preset)
    named = {flag.partition("=")[0] for flag in others}
    if "--ppo.worlds" in named:
        if "--fit-memory" in named:
            raise InputError("--fit-memory", "--ppo.worlds as well", "one of the two")
        default = replace(default, fit_memory=False)
    asked = replace(default, preset=known.preset)  # so that the help's default is auto, not cpu
    config = parsed(TrainConfig, description, args=argv, default=asked)
    return replace(config, preset=default.preset)
