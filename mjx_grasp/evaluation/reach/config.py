"""What a reach sweep is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mjx_grasp.records.settings import CommandSettings, Count, Seed, Suffix


@dataclass(frozen=True)
class SweepConfig(CommandSettings):
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
