"""Every number of closing and lifting, one class per concept (method §5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import Count, NonNegative, Positive, Settings, Share


@dataclass(frozen=True)
class ActionConfig(Settings):
    """What a policy's actions, which reach from −1 to 1, do."""

    finger_rate: NonNegative = 5.0
    """finger joint velocity residual at action 1 [rad/s]"""
    arm_rate: NonNegative = 0.15
    """arm joint velocity residual at action 1 [rad/s]"""
    arm_settles: bool = False
    """whether the arm is left alone once the lift is over: what moves it a little in every tick
    carries it off in a long hold"""
    residual: Literal["leaky", "integrated"] = "leaky"
    """how finger residuals act: a bounded leak (default), or integrated as published"""
    keep: Share = 0.8
    """share of the leaky residual that survives a tick [-]"""
    limit: NonNegative = 0.25
    """bound of the leaky residual [rad]"""
    others: bool = False
    """whether joints of arm and fingers that closing leaves alone have actions too, until the lift:
    the arm's at the arm's rate, the fingers' at theirs"""
    grip_range: Positive = 1.0
    """factor on the grip's force at action 1, its inverse at −1, in one action more, smoothed as
    the leaky residuals are; 1 for no such action [-]"""

    @property
    def of_grip(self) -> bool:
        """Whether there is an action on the grip's force."""
        return self.grip_range != 1.0


@dataclass(frozen=True)
class GuidanceConfig(Settings):
    """The vector field that brings the pads to their contacts, and how finger joints follow it."""

    speed: Positive = 0.08
    """v_max: speed of the guided pads towards their contacts [m/s]"""
    slowdown: Positive = 0.02
    """ε_p: distance to the contact below which the speed falls [m]"""
    return_rate: NonNegative = 4.0
    """η: rate of return to the straight line [1/s]"""
    turn_rate: NonNegative = 4.0
    """k_R: rate of alignment with the surface [1/s]"""
    turn_weight: NonNegative = 0.003
    """of a pad's turn in the fingers' least squares; with the rewards' 0.05 the turn that three
    joints cannot follow keeps the pads 10–30 mm away from their contacts [m/rad]"""
    lead: NonNegative = 0.1
    """most that a guided joint target runs ahead of its joint: no force is wound up against
    whatever stops a finger before it lands [rad]"""
    damping: Positive = 1e-4
    """λ of the fingers' damped least squares [m²]"""
    rate_limit: Positive = 3.0
    """bound on the guided finger joint velocities [rad/s]"""


@dataclass(frozen=True)
class GripConfig(Settings):
    """The force with which the fingers press once they are there."""

    force: NonNegative = 1.0
    """commanded inward force per finger F: 1 for the policy, 3 for the squeeze baseline [N]"""
    ramp_s: NonNegative = 0.5
    """from landing, or from arrival, to the full force [s]"""
    arrival: NonNegative = 0.005
    """way left to the contact at which a finger has arrived and grips even without touching:
    targets that are not on the surface would otherwise never be reached; 0: none arrives so [m]"""
    together: bool = True
    """whether the fingers' forces rise together, once all have landed or arrived"""
    approach_s: NonNegative | None = 1.0
    """after this time every finger counts as arrived; None: time alone brings none [s]"""
    freezes: bool = True
    """whether a finger's guided target stays where it is once the finger has landed; else it goes
    on along the field until the lift, as published"""
    split: Literal["even", "balanced"] = "even"
    """whether each finger presses with F, or the thumb with as much as the others together and all
    three with 3 F in sum in either case"""
    direction: Literal["normals", "line"] = "normals"
    """along what the fingers press: the contacts' normals, or the line between the thumb's pad and
    the middle of the others"""
    follow: Share = 0.0
    """share of the way to its joint that a landed finger's target goes every tick: with 0 it is a
    spring that lets go as the finger gives way, above it a force [-]"""
    settles: bool = False
    """whether targets stop following once the lift is over: a force that follows gives way for as
    long as it holds"""
    friction: Positive | None = None
    """μ₀: from lift onset F follows the load as if this were the friction, from `force` up to
    `most`; none: F stays as it is [-]"""
    most: NonNegative = 8.0
    """to which the load may raise F [N]"""
    rise: NonNegative = 60.0
    """how fast the load may raise F [N/s]"""
    fall: NonNegative = 2.0
    """how fast F may go back [N/s]"""


REACTING = GripConfig(
    force=2.5, split="balanced", direction="line", follow=0.05, settles=True, friction=0.4
)
"""A grip that holds its force and answers to load."""


@dataclass(frozen=True)
class ForceConfig(Settings):
    """Fingertip forces from the observer's joint torques."""

    joints: Literal["all", "moved"] = "all"
    """whose torques are felt: those of all joints of a finger, or of those alone that close it,
    which may be parallel and then do not feel what goes along their axes"""
    damping: Positive = 0.01
    """λ: lever below which a joint's torque says little of the force [m]"""
    most: Positive = 40.0
    """largest force that is believed [N]"""
    sticking: Positive | None = None
    """speed at which a joint's dry friction acts in full against its motion and is left out of the
    estimate; none: it is felt as a force [rad/s]"""


@dataclass(frozen=True)
class StageConfig(Settings):
    """When contact acquisition ends and the lift begins."""

    acquisition_s: NonNegative = 1.6
    """after this time fewer fingers than all suffice [s]"""
    fingers: Count = 2
    """that suffice then [-]"""


@dataclass(frozen=True)
class LiftConfig(Settings):
    """The scripted lift of the palm."""

    speed: Positive = 0.15
    """of the palm, straight up [m/s]"""
    height: Positive = 0.15
    """at which the lift stops [m]"""
    ramp_s: NonNegative = 0.2
    """in which the speed's trapezoid rises, and falls [s]"""
    delay_s: NonNegative = 0.5
    """from the change of stage to the first motion, in which the grip builds up; 0 as published
    [s]"""
    damping: Positive = 1e-4
    """λ of the arm's damped least squares [m²]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ramp_s * self.speed > self.height:
            raise InputError(self.name_of("ramp_s"), self.ramp_s, "at most height / speed")


@dataclass(frozen=True)
class ObserverConfig(Settings):
    """The momentum observer and its contact flags."""

    gain: Positive = 50.0
    """K [1/s]"""
    stall_speed: Positive = 0.1
    """finger joint speed under which a torque counts as contact [rad/s]"""
    contact_torque: Positive = 0.03
    """estimated external torque that counts as contact [N m]"""
    contact_ticks: Count = 3
    """in a row before a contact is reported [-]"""
    stop_margin: NonNegative = 0.03
    """joints nearer than this to a stop are left out [rad]"""


@dataclass(frozen=True)
class CloserConfig(Settings):
    """The closing controller."""

    control_dt: Positive = 0.01
    """control period [s]"""
    action: ActionConfig = field(default_factory=ActionConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    grip: GripConfig = field(default_factory=GripConfig)
    stages: StageConfig = field(default_factory=StageConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    observer: ObserverConfig = field(default_factory=ObserverConfig)
    forces: ForceConfig = field(default_factory=ForceConfig)
