"""Rows of results whose trials were kept, with outcomes and forces as they are asked for."""

import numpy as np

from mjx_grasp.evaluation.conditions import read_groups
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.robot.identity import FIRST_ROBOT

PROVENANCE = {"command": "c", "git": "g", "versions": {}, "device": "a card", "seed": 0}


def row(outcomes, forces, starts=None, name="apple", **changes):
    lifted = [f for f in forces if f is not None]
    n, successes = len(outcomes), outcomes.count("S")
    values = dict(
        object=name, controller="policy", engine="mujoco", episodes=n, successes=successes,
        never_lifted=outcomes.count("L"), not_held=outcomes.count("H"),
        slipped=outcomes.count("P"), ci95=wilson_interval(successes, n),
        force_mean_n=float(np.mean(lifted)) if lifted else None, force_peak_n=9.0,
        squeeze_force_n=None, offset_mm=5.0, angle_deg=0.0, friction=0.8, handoffs="ik",
        outcomes=outcomes, forces_n=tuple(forces),
        starts=tuple(range(n) if starts is None else starts),
        force_peak_p50_n=3.0, force_peak_p99_n=7.0,
    )  # fmt: skip
    return ResultRow(**(values | changes))


def squeeze(force, *args, **changes):
    return row(*args, controller="squeeze", squeeze_force_n=force, squeeze_split="even", **changes)


def groups_of(tmp_path, *rows):
    write_results(tmp_path / "r.json", list(rows), PROVENANCE, FIRST_ROBOT)
    return read_groups([tmp_path / "r.json"])
