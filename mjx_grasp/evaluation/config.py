"""What an evaluation is asked for: controller, objects, condition, files."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.closing.learned import KEEPING
from mjx_grasp.errors import InputError
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.records.settings import Count, NonNegative, Positive, Range, Seed, Suffix
from mjx_grasp.records.spread import Spread
from mjx_grasp.sim.engines import Engine
from mjx_grasp.tasks.config import MAX_ANGLE_RAD, MAX_OFFSET_M, RobotErrors, StartNoise


@dataclass(frozen=True)
class EvaluateConfig(ObjectsConfig, Spread):
    """Evaluates a controller by the criterion of success (method §7)."""

    out: Annotated[Path, Suffix((".json",))]
    """results file (.json)"""
    controller: Literal["policy", "squeeze", "grip"] = "policy"
    """the trained policy; the model-based command alone, with --squeeze-force; or the same with a
    grip that answers to the load that it feels in its joints, --grip.*"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    episodes: Count = 64
    """episodes per object [-]"""
    engine: Engine = "mujoco"
    """what steps the physics: mujoco (native, in threads) or mjx (Warp, GPU or CPU)"""
    seed: Seed = 0
    """of the starts: every controller gets the same ones from the same seed"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    states: Literal["evaluation", "training", "all"] = "evaluation"
    """which part of the handoff set: by default the states that no training sees"""
    squeeze_force: NonNegative = 3.0
    """commanded force per finger of the squeeze [N]"""
    squeeze_split: Literal["even", "balanced"] = "even"
    """how the squeeze shares it out; balanced: the thumb presses as hard as the others together"""
    grip: GripConfig = REACTING
    """the grip of the controller grip"""
    force_budget: Positive = 3.0
    """mean force per finger that a policy which knows a budget may take [N]"""
    keeping_gain: NonNegative = KEEPING.gain
    """how fast the budget that it is told follows what it spares or spends too much; 0: it is told
    its own, as in its training [1/s]"""
    offset_mm: Annotated[float, Range(0, 1e3 * MAX_OFFSET_M)] = 5.0
    """lateral object offset, uniform in ± this along x and y [mm]"""
    angle_deg: Annotated[float, Range(0, math.degrees(MAX_ANGLE_RAD))] = 0.0
    """object rotation about a random axis, uniform up to this [deg]"""
    friction: Positive = 0.8
    """sliding friction of the object's contacts [-]"""
    friction_spread: NonNegative = 0.0
    """by which the friction differs from that in a trial, uniform in ± this [-]"""
    mass_scale: Positive = 1.0
    """factor on the object's mass [-]"""
    robot_errors: RobotErrors = field(default_factory=RobotErrors)
    """how the robot differs from its model: gains, latency, noise of its torque sensors"""
    worlds: Count | None = None
    """worlds per batch; by default 256 in native MuJoCo and 4,096 in MJX [-]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.friction_spread >= self.friction:
            less = f"less than the friction ({self.friction:g})"
            raise InputError(self.name_of("friction_spread"), self.friction_spread, less)

    @property
    def noise(self) -> StartNoise:
        """The condition as the environment's noise."""
        return StartNoise(
            offset_m=self.offset_mm * 1e-3,
            angle_rad=min(math.radians(self.angle_deg), MAX_ANGLE_RAD),
            friction=(self.friction - self.friction_spread, self.friction + self.friction_spread),
            mass_scale=(self.mass_scale, self.mass_scale),
            budget_n=(self.force_budget, self.force_budget),
            robot=self.robot_errors,
        )


_OWN = {
    "policy": ("policy", "force_budget", "keeping_gain"),
    "squeeze": ("squeeze_force", "squeeze_split"),
    "grip": ("grip",),
}
"""Fields that mean something to one controller alone."""


def check_own_settings(config: EvaluateConfig) -> None:
    """Refuses settings of another controller than the one that is evaluated.

    Raises:
        InputError: One differs from its default.
    """
    usual = EvaluateConfig(config.out)
    for controller, names in _OWN.items():
        for name in names if controller != config.controller else ():
            value = getattr(config, name)
            if value != getattr(usual, name):
                expected = f"nothing beside --controller {config.controller}: it is of {controller}"
                raise InputError(config.name_of(name), value, expected)
