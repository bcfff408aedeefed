"""Every number of the search for postures, in one place."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import Count, NonNegative, Positive, Settings


@dataclass(frozen=True)
class ClearanceConfig(Settings):
    """How far the robot is to keep from things."""

    object: NonNegative = 0.010
    """hand and arm to the object [m]"""
    obstacles: NonNegative = 0.010
    """hand and arm to obstacles [m]"""
    hand_table: NonNegative = 0.012
    """hand to table [m]"""
    arm_table: NonNegative = 0.050
    """arm to table [m]"""
    fingers: NonNegative = 0.002
    """finger to finger [m]"""
    arm: NonNegative = 0.010
    """outer links of the arm to its base and inner links [m]"""
    joint_limits: NonNegative = 0.05
    """every joint to its limits, at most a quarter of its range [rad]"""

    def wider(self, margin: float) -> ClearanceConfig:
        """All distances by a margin more, [m]."""
        names = ("object", "obstacles", "hand_table", "arm_table", "fingers", "arm")
        return replace(self, **{name: getattr(self, name) + margin for name in names})


@dataclass(frozen=True)
class IkConfig(Settings):
    """Inverse kinematics of the three fingertips."""

    iterations: Count = 30
    """Levenberg–Marquardt steps, fixed [-]"""
    damping: Positive = 1e-3
    """of the first of them; far from a solution the first steps of little damping are wasted [-]"""
    orientation_weight: NonNegative = 0.012
    """pad normals against tips [m/rad]"""
    posture_weight: NonNegative = 0.001
    """pull of arm and grasping fingers towards the reference posture [m/rad]"""
    idle_weight: NonNegative | None = 0.01
    """the same of the other fingers; None holds them there [m/rad]"""
    clearance_weight: NonNegative = 2.0
    """missing clearance against tip errors [m/m]"""


@dataclass(frozen=True)
class StartConfig(Settings):
    """Which entries of a library a search starts from."""

    near: Count = 1024
    """entries around the object, which are compared with the goals [-]"""
    count: Count = 32
    """of them, the most promising [-]"""
    direction_scale: NonNegative = 0.03
    """a difference of pad directions counts as much as tips this far off [m]"""
    chance: NonNegative = 0.02
    """so far off at random is what is around the object, for other keys to find others [m]"""
    time_scale: NonNegative = 0.05
    """an entry this much farther in time counts as much as tips this far off [m/s]"""
    overlap_weight: NonNegative = 0.0
    """what spheres of the hand overlap object and table counts as much as tips this many times as
    far off [-]"""
    ranked: Count = 96
    """entries nearest to the goals, of which the overlap is estimated [-]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count > self.near:
            expected = f"at most near, {self.near}: the starts are some of those"
            raise InputError(self.name_of("count"), self.count, expected)
        if self.overlap_weight > 0 and self.count > self.ranked:
            expected = f"at most ranked, {self.ranked}: the starts are some of those"
            raise InputError(self.name_of("count"), self.count, expected)
