"""What an evaluation is asked for: controller, objects, condition, files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mjx_grasp.errors import InputError
from mjx_grasp.tasks.assemble import Engine
from mjx_grasp.tasks.config import MAX_ANGLE_RAD, MAX_OFFSET_M, StartNoise


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluates a controller by the criterion of success (method §7)."""

    out: Path
    """Results file (JSON)."""
    controller: Literal["policy", "squeeze"] = "policy"
    """The trained policy, or the model-based command alone with --squeeze-force."""
    objects: tuple[str, ...] = ("eight",)
    """Objects or groups (eight, train, held_out, all); those without start states are reported."""
    objects_dir: Path | None = None
    """Folder of real scans; parametric stand-ins without one."""
    robot: str = "rizon4_hx5d20"
    """Name or description file of the robot."""
    episodes: int = 64
    """Episodes per object."""
    engine: Engine = "mujoco"
    """What steps the physics: mujoco (native, in threads) or mjx (Warp, GPU or CPU)."""
    seed: int = 0
    """Of the starts: every controller gets the same ones from the same seed."""
    policy: Path | None = None
    """Policy file; the shipped one by default."""
    handoffs: Path | None = None
    """Handoff set; the shipped one by default."""
    states: Literal["evaluation", "training", "all"] = "evaluation"
    """Which part of the handoff set: by default the states that no training sees."""
    squeeze_force: float = 3.0
    """Commanded force per finger of the squeeze [N]."""
    offset_mm: float = 5.0
    """Lateral object offset, uniform in ± this along x and y [mm]."""
    angle_deg: float = 0.0
    """Object rotation about a random axis, uniform up to this [deg]."""
    friction: float = 0.8
    """Sliding friction of the object's contacts [-]."""
    worlds: int = 256
    """Worlds per batch."""

    def __post_init__(self):
        if self.episodes < 1:
            raise InputError("--episodes", self.episodes, "at least 1")
        if self.worlds < 1:
            raise InputError("--worlds", self.worlds, "at least 1")
        if not 0 <= self.squeeze_force < math.inf:
            raise InputError("--squeeze-force", self.squeeze_force, "0 N or more")
        if not 0 <= self.offset_mm * 1e-3 <= MAX_OFFSET_M:
            raise InputError("--offset-mm", self.offset_mm, f"0 to {1e3 * MAX_OFFSET_M:g} mm")
        if not 0 <= math.radians(self.angle_deg) <= MAX_ANGLE_RAD:
            most = math.degrees(MAX_ANGLE_RAD)
            raise InputError("--angle-deg", self.angle_deg, f"0 to {most:.1f} degrees")
        if not 0 < self.friction < math.inf:
            raise InputError("--friction", self.friction, "a positive number")

    @property
    def noise(self) -> StartNoise:
        """The condition as the environment's noise."""
        return StartNoise(
            offset_m=self.offset_mm * 1e-3,
            angle_rad=math.radians(self.angle_deg),
            friction=(self.friction, self.friction),
        )
