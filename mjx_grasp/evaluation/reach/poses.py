"""What a reach sweep is asked for, and its randomised cylinders (method §3)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mjx_grasp.records.atomic import check_replaceable, check_writable
from mjx_grasp.records.settings import (
    Count,
    Interval,
    Positive,
    Seed,
    Settings,
    Several,
    Suffix,
)
from mjx_grasp.records.spread import Spread

SCHEMA = "mjx_grasp.reach_sweep/1"
"""What results files say that they are."""
TUNING_SEEDS = (1, 2, 3, 2752)
"""Poses on which settings were chosen or faults were found; results that count come from others."""
Lengths = Annotated[tuple[Positive, Positive], Several(ascending=True)]
"""A shortest and a longest length [m]."""


@dataclass(frozen=True)
class SweepConfig(Spread):
    """What to sweep, and what to write."""

    poses: Count = 2752
    """randomised cylinder poses [-]"""
    seed: Seed = 20
    """of the poses; 1, 2, 3 and 2752 were used to choose settings"""
    preset: str = "default"
    """paper, standoffs, escape, reachability, guide, straight, clearance or default"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    bound: bool = True
    """also report the share of poses for which a solution exists at all"""
    chunk: Count | None = None
    """poses worked on at once; by default 128 on a CPU, all of them on an accelerator [-]"""
    out: Annotated[Path, Suffix((".json",))] | None = None
    """results file to write (.json)"""
    plot: Annotated[Path, Suffix((".png",))] | None = None
    """plot to write (.png)"""


def check_outputs(config: SweepConfig) -> None:
    """Makes sure that what is asked for can be written, and replaces nothing but its like.

    Raises:
        InputError: It cannot, or would.
    """
    if config.out:
        check_replaceable("--out", config.out, [SCHEMA])
    if config.plot:
        check_writable("--plot", config.plot)


@dataclass(frozen=True)
class PoseDistribution(Settings):
    """What is drawn uniformly, and from where."""

    radius: Lengths = (0.020, 0.045)
    """of the cylinder [m]"""
    height: Lengths = (0.080, 0.200)
    """of the cylinder, end to end [m]"""
    x: Interval = (0.40, 0.65)
    """of its centre [m]"""
    y: Interval = (-0.25, 0.25)
    """of its centre [m]"""


class CylinderPoses(NamedTuple):
    """Cylinders at rest on the table; arrays of one batch."""

    radius: Float[np.ndarray, " n"]
    """[m]"""
    half_length: Float[np.ndarray, " n"]
    """half the height [m]"""
    p_wo: Float[np.ndarray, "n 3"]
    """centres in world [m]"""
    R_wo: Float[np.ndarray, "n 3 3"]
    """rotations; the axis is z"""
    lying: Bool[np.ndarray, " n"]
    """on its side, else upright"""


def draw_poses(count: int, seed: int) -> CylinderPoses:
    """Random cylinders: sizes, xy and yaw uniform; every other one upright, the rest lying.

    Args:
        count: How many.
        seed: Of the draw; the first poses of a longer draw are those of a shorter one.
    """
    d = PoseDistribution()
    ranges = np.array([d.radius, d.height, d.x, d.y, (-np.pi, np.pi)])
    unit = np.random.default_rng(seed).random((count, len(ranges)))
    radius, height, x, y, yaw = (ranges[:, 0] + unit * np.ptp(ranges, axis=1)).T
    lying = np.arange(count) % 2 == 1
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(count), np.ones(count)
    upright_R = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]])
    # The axis z horizontal, along the yaw.
    lying_R = np.array([[zero, s, c], [zero, -c, s], [one, zero, zero]])
    R_wo = np.moveaxis(np.where(lying, lying_R, upright_R), -1, 0)
    p_wo = np.stack([x, y, np.where(lying, radius, 0.5 * height)], axis=-1)
    f32 = np.float32
    return CylinderPoses(
        radius.astype(f32), (0.5 * height).astype(f32), p_wo.astype(f32), R_wo.astype(f32), lying
    )
