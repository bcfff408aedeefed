"""Every number of the handoff dataset, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.config import TargetConfig


def _whole_from_1(config: object, *names: str) -> None:
    for name in names:
        if getattr(config, name) < 1:
            field = f"{type(config).__name__}.{name}"
            raise InputError(field, getattr(config, name), "a whole number from 1")


@dataclass(frozen=True)
class SamplingConfig:
    """Object poses on the table and the candidates tried on them (method §0, §4)."""

    x_range: tuple[float, float] = (0.40, 0.65)
    """object area in front of the arm [m]"""
    y_range: tuple[float, float] = (-0.25, 0.25)
    """object area, lateral [m]"""
    poses_per_round: int = 128
    """object poses drawn at a time [-]"""
    candidates_per_pose: int = 3
    """heatmap candidates tried on each [-]"""
    min_score: float = 0.05
    """candidates below this are not used, as in the selection [-]"""
    temperature: float = 0.2
    """candidates are drawn with weight exp(score/temperature) [-]"""
    min_distance: float = 0.008
    """of the candidates of one pose, thumb contacts are at least this far apart [m]"""

    def __post_init__(self):
        for name in ("x_range", "y_range"):
            low, high = getattr(self, name)
            if not -math.inf < low <= high < math.inf:
                raise InputError(f"SamplingConfig.{name}", (low, high), "low <= high [m]")
        _whole_from_1(self, "poses_per_round", "candidates_per_pose")
        if not self.temperature > 0:
            raise InputError("SamplingConfig.temperature", self.temperature, "a positive number")
        if not self.min_distance >= 0:
            raise InputError("SamplingConfig.min_distance", self.min_distance, "0 m or more")


@dataclass(frozen=True)
class IkConfig:
    """The batched inverse kinematics."""

    iterations: int = 30
    """Levenberg–Marquardt steps, fixed [-]"""
    restarts: int = 4
    """starting configurations per candidate [-]"""
    library_size: int = 60_000
    """configurations from which the starts nearest to the targets are taken [-]"""
    orientation_weight: float = 0.012
    """pad normal against the inward direction [m/rad]"""
    posture_weight: float = 0.001
    """pull towards the open posture at home [m/rad]"""
    clearance: float = 0.003
    """hand spheres nearer than this to object, table or another finger are pushed away [m]"""
    clearance_weight: float = 0.5
    """of what is missing to that, against tip errors [m/m]"""
    limit_margin: float = 0.05
    """kept from every joint limit [rad]"""
    tolerance: float = 0.005
    """a larger tip error rejects [m]"""

    def __post_init__(self):
        _whole_from_1(self, "iterations", "restarts", "library_size")
        if not self.tolerance > 0:
            raise InputError("IkConfig.tolerance", self.tolerance, "a positive length [m]")


@dataclass(frozen=True)
class HandoffConfig:
    """Settings of `python -m mjx_grasp.handoffs`."""

    out: Path
    """the handoff set to write (.npz); a report (.json) is written beside it"""
    objects: tuple[str, ...] = ("eight",)
    """object names or groups: eight, train, held_out, all"""
    update: Path | None = None
    """an earlier set, with its report: what it has of other objects is taken over"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without it"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    per_object: int = 128
    """pre-grasps wanted of each object [-]"""
    max_rounds: int = 20
    """rounds of sampling before an object is left with what it has [-]"""
    max_per_candidate: int = 4
    """pre-grasps that may share one heatmap candidate [-]"""
    seed: int = 0
    """of everything random; an object's states do not depend on the other objects"""
    targets: TargetConfig = field(default_factory=TargetConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    ik: IkConfig = field(default_factory=IkConfig)

    def __post_init__(self):
        for name in ("per_object", "max_rounds", "max_per_candidate"):
            if getattr(self, name) < 1:
                raise InputError(name, getattr(self, name), "a whole number from 1")
        if self.out.suffix != ".npz":
            raise InputError("out", str(self.out), "a file name ending in .npz")
