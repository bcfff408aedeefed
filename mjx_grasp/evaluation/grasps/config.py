"""What whole grasps are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.records.settings import Count, Positive, Seed, Suffix


@dataclass(frozen=True, kw_only=True)
class GraspsConfig(ObjectsConfig):
    """Which grasps from home, whoever makes them."""

    scenarios: tuple[str, ...] = ("all",)
    """scenarios by name, all of them, or files of your own (.yaml)"""
    episodes: Count = 8
    """of each object in each scenario [-]"""
    seed: Seed = 0
    """of the poses, the plans and what happens"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    force_budget: Positive = 3.0
    """mean force per finger that a policy which knows a budget may take [N]"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""


@dataclass(frozen=True, kw_only=True)
class ScenariosConfig(GraspsConfig):
    """Grasps from home in native MuJoCo, while this or that happens."""

    out: Annotated[Path, Suffix((".json",))]
    """results file (.json); one that an interrupted run left is gone on with"""
    controller: Literal["grip", "policy"] = "grip"
    """what closes: a grip that answers to load, or a policy on top of it"""
