"""What a reach sweep leaves: its results file, a plot, and pictures of failures.

Imports MuJoCo only when something is written, so that `check_outputs` can refuse before it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.reach.config import SweepConfig
from mjx_grasp.records.atomic import check_writable, replacing, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.viz import frames
from mjx_grasp.viz.rendering import INSTALL

if TYPE_CHECKING:
    from mjx_grasp.evaluation.reach.run import SweepRun
    from mjx_grasp.reaching.presets import ReachPreset
    from mjx_grasp.robot.spec import RobotSpec


def check_outputs(config: SweepConfig) -> None:
    """Makes sure that all can be written; pictures come last, after minutes.

    Raises:
        InputError: A file cannot be written, or a gallery is asked for where MuJoCo cannot render.
    """
    for name in ("out", "plot", "gallery"):
        if getattr(config, name) is not None:
            check_writable(config.name_of(name), getattr(config, name))
    if config.gallery is None:
        return
    try:
        frames.check_backend()
    except frames.BackendError as error:
        backend = os.environ.get("MUJOCO_GL")
        found = f"no renderer with MUJOCO_GL={backend}" if backend else "no renderer"
        raise InputError(
            config.name_of("gallery"),
            f"{config.gallery}, but {found} ({error})",
            f"a renderer for the pictures: MUJOCO_GL=egl without a screen; {INSTALL}",
        ) from error


def write_outputs(
    config: SweepConfig, settings: ReachPreset, robot: RobotSpec, run: SweepRun
) -> Iterator[Path]:
    """Writes what was asked for, and names each file.

    Args:
        config: What the sweep was asked for.
        settings: Those of its preset.
        robot: What reached.
        run: The sweep.
    """
    from mjx_grasp.evaluation.reach.poses import TUNING_SEEDS, PoseDistribution
    from mjx_grasp.viz.reach import failure_gallery, rate_plot

    if config.out:
        facts = {
            "provenance": provenance(config.seed),
            "robot": to_record(robot.identity),
            "tuning_seeds": TUNING_SEEDS,
            "preset": config.preset,
            "distribution": to_record(PoseDistribution()),
            "settings": to_record(settings),
        }
        write_json(config.out, facts | run.result)
        yield config.out
    if config.plot:
        with replacing(config.plot) as temporary:
            temporary.write_bytes(rate_plot(run.result, config.preset))
        yield config.plot
    if config.gallery:
        failure_gallery(config.gallery, robot, run.poses, run.record, run.classes)
        yield config.gallery
