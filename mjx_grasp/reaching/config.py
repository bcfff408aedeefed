"""Every number of reactive reaching, in one place (method §3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from mjx_grasp.posture.config import ClearanceConfig
from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveOrNever,
    Range,
    Settings,
    WholeNumber,
)

SoftThreshold = tuple[NonNegative, Positive]
"""Where a :func:`~mjx_grasp.reaching.fields.gate` is half open, and its width."""


@dataclass(frozen=True)
class FieldConfig(Settings):
    """Task-space velocities of fingertips, pads and hand."""

    speed: Positive = 0.5
    """of a fingertip far from its target [m/s]"""
    slow_down: Positive = 0.1
    """distance to the target within which it slows down, proportionally [m]"""
    path_clearance: NonNegative = 0.010
    """a straight way this far from the object is free [m]"""
    via_points: WholeNumber = 100
    """on a sphere around the goal, tried when the straight way is not free [-]"""
    via_radius: Positive = 0.070
    """of that sphere [m]"""
    path_samples: Count = 12
    """of a segment, at which its clearance is measured [-]"""
    orientation_gain: NonNegative = 5.0
    """angular speed per sine of the angle between pad normal and its goal [rad/s]"""
    orientation_weight: NonNegative = 0.003
    """of pads against tips, (rad/s)² against (m/s)² [m²/rad²]"""
    orientation_angle: SoftThreshold = (0.5235988, 0.0872665)
    """gate that opens with the angle: 30°, 5° [rad]"""
    arrival: SoftThreshold = (0.030, 0.010)
    """gate of the midpoint error that opens on arrival [m]"""
    far: SoftThreshold = (0.10, 0.010)
    """gate of the midpoint error that opens far away: the hand opens there [m]"""
    posture_gain: NonNegative = 5.0
    """joint speed per joint error [1/s]"""
    posture_speed: Positive = 1.0
    """at most, towards the open posture [rad/s]"""
    posture_weight: NonNegative = 0.002
    """of a hand joint's posture against tips, (rad/s)² against (m/s)² [m²/rad²]"""


@dataclass(frozen=True)
class GuideConfig(Settings):
    """How a planned configuration guides the hand; not in the paper."""

    enabled: bool = True
    """whether plans guide the hand, or only choose the candidate"""
    length: Positive = 0.15
    """of the funnel: how far the hand retreats [m]"""
    aligned: Positive = 0.08
    """misalignment below which the hand comes in [m]"""
    lever: Positive = 0.1
    """of a rotation error against a position error [m/rad]"""
    speed: Positive = 0.8
    """at which the hand comes in when aligned perfectly [m/s]"""
    palm_speed: Positive = 0.5
    """of the palm towards its goal, at most [m/s]"""
    palm_gain: NonNegative = 8.0
    """speed per error, of position and rotation [1/s]"""
    palm_weight: NonNegative = 0.1
    """of the palm's velocity against that of a tip [-]"""
    palm_turn_weight: NonNegative = 0.01
    """of its angular velocity [m²/rad²]"""
    arm_weight: NonNegative = 0.5
    """of an arm joint's way to the configuration [m²/rad²]"""
    hand_weight: NonNegative = 0.05
    """the same of a hand joint [m²/rad²]"""
    settled_arm_weight: NonNegative = 0.05
    """the same once nothing of the retreat is left [m²/rad²]"""
    damping: Positive = 0.05
    """of the steps by which the configurations follow a moving object [m]"""
    limit_margin: NonNegative = 0.05
    """they keep from every joint limit [rad]"""
    astray: SoftThreshold = (0.03, 0.01)
    """gate of their palm error that takes the arm's configuration back, where it cannot follow:
    from there on the palm's pose alone leads [m]"""
    astray_palm: NonNegative = 10.0
    """factor of the palm's weights then [-]"""
    tip_weight: NonNegative = 0.1
    """of the tips while the whole retreat is left; 1 when nothing is [-]"""


@dataclass(frozen=True)
class LimitConfig(Settings):
    """What every command must respect."""

    horizon: Positive = 0.05
    """time over which position limits and clearances are looked ahead [s]"""
    clearances: ClearanceConfig = field(default_factory=ClearanceConfig)
    """how far to keep from things"""
    escape_speed: Positive = 0.35
    """at most, asked for where a clearance is violated [m/s]"""
    margin: NonNegative = 0.0
    """half-spaces ask for this much more than the clearances, so that these themselves hold: a
    command that would end its tick below one is scaled back, if need be to nothing; 0 in the
    paper, which bounds the nearest points alone [m]"""
    follow_object: bool = False
    """clearances and targets move with the object's own velocity"""
    object_speed: PositiveOrNever = 0.5
    """apparent object speed above which it is a jump and not a motion [m/s]"""


@dataclass(frozen=True)
class SolverConfig(Settings):
    """The objective's regularisation and the ADMM iteration."""

    arm_effort: Positive = 0.05
    """R of arm joints [m²/rad²]"""
    hand_effort: Positive = 0.001
    """R of hand joints [m²/rad²]"""
    smoothness: NonNegative = 0.01
    """λ of the change since the last tick [m²/rad²]"""
    iterations: Count = 50
    """warm-started, fixed [-]"""
    rho_box: Positive = 0.1
    """step of the velocity box, variables scaled [-]"""
    rho_rows: Positive = 0.3
    """step of the half-spaces [-]"""
    relaxation: Annotated[float, Range(0, 2, above=True)] = 1.6
    """over-relaxation [-]"""
    feasible: NonNegative = 0.02
    """a command that violates a half-space by more than this is not used [m/s]"""
    partial_escape: bool = False
    """where not all violated clearances can be restored at once, an answer that makes none of
    them worse is used, in place of standing still, and less is asked for until there is one; not
    in the paper"""


@dataclass(frozen=True)
class HandoffGate(Settings):
    """When the hand is near enough for the closing policy (method §3, 'Handoff')."""

    midpoint: NonNegative = 0.010
    """midpoint error below which it is [m]"""
    tips: PositiveOrNever = float("inf")
    """largest tip error with which it is; the paper looks at the midpoint alone [m]"""
    tip_speed: PositiveOrNever = float("inf")
    """speed of the fastest tip with which it is [m/s]"""
    near: PositiveOrNever = float("inf")
    """time for which the following has to last; never in the paper [s]"""
    near_tips: NonNegative = 0.015
    """largest tip error during that time: closing makes up for so much, and to wait for less, or to
    try another plan, takes longer than that is worth [m]"""
    late: PositiveOrNever = 3.0
    """fine-adjustment timer from which the following is enough [s]"""
    late_tips: NonNegative = 0.050
    """largest tip error with which it then is [m]"""
    stalled_tips: NonNegative = 0.0
    """largest tip error with which it is where progress stalls, in place of another plan: what the
    hand can do is done, and closing may make up for the rest; never in the paper [m]"""


@dataclass(frozen=True)
class ControllerConfig(Settings):
    """When a reach ends, and how (method §3, 'Fine-adjustment timer', 'Handoff')."""

    dt: Positive = 0.01
    """control period [s]"""
    fine_distance: Positive = 0.140
    """the fine-adjustment timer runs while the largest tip error is below [m]"""
    fine_timeout: PositiveOrNever = 3.0
    """of the fine-adjustment timer [s]"""
    gate: HandoffGate = field(default_factory=HandoffGate)
    """what the hand has to come to"""
    hands_off: bool = True
    """whether a reach ends as a handoff when the gate opens; else it goes on and only says so"""
    reselections: WholeNumber = 1
    """tries with another candidate before a reach fails [-]"""
    reselect_late: bool = True
    """whether the fine-adjustment time-out leads to another candidate before it fails"""
    timeout: PositiveOrNever = 10.0
    """of the whole reach [s]"""
    stall_time: PositiveOrNever = float("inf")
    """without progress after which another plan is taken; the paper waits for the time-out [s]"""
    stall_progress: NonNegative = 0.02
    """what counts as progress: less time to go, at full speed [s]"""
    replan_moved: PositiveOrNever = float("inf")
    """new plans are asked for when the object has come to rest this far from where the present ones
    were made for, a turn counting with the guide's lever, or when all of them have stalled; never
    in the paper, which has none [m]"""
    stall_error: NonNegative = 0.010
    """a largest tip error below which nothing needs to progress any more [m]"""


@dataclass(frozen=True)
class ReachConfig(Settings):
    """Settings of the reaching controller."""

    fields: FieldConfig = field(default_factory=FieldConfig)
    guide: GuideConfig = field(default_factory=GuideConfig)
    limits: LimitConfig = field(default_factory=LimitConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
