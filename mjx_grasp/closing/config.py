"""Every number of the closing task (method §5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mjx_grasp.errors import InputError

MAX_OFFSET_M = 0.05
"""Largest object offset that a start may have [m]."""
MAX_ANGLE_RAD = 0.8
"""Largest object rotation that a start may have [rad]."""


@dataclass(frozen=True)
class ClosingConfig:
    """The closing task: actions, model-based command, rewards, stages, observer."""

    control_dt: float = 0.01
    """Control period [s]."""
    episode_s: float = 4.0
    """Time to close, lift and hold [s]."""

    finger_action_rate: float = 5.0
    """Finger joint velocity residual at action 1 [rad/s]."""
    arm_action_rate: float = 0.15
    """Arm joint velocity residual at action 1 [rad/s]."""
    residual: Literal["leaky", "integrated"] = "leaky"
    """How finger residuals act: a bounded leak (default), or integrated as published."""
    residual_keep: float = 0.8
    """Share of the leaky residual that survives a tick [-]."""
    residual_limit: float = 0.25
    """Bound of the leaky residual [rad]."""

    grip_force: float = 1.0
    """Commanded inward force per finger F [N]: 1 for the policy, 3 for the squeeze baseline."""
    grip_ramp_s: float = 0.5
    """Time from landing, or from arrival, to the full force [s]."""
    arrival_distance: float = 0.005
    """Way left to the contact at which a finger has arrived and grips even without touching [m]:
    targets that are not on the surface would otherwise never be reached."""
    grip_together: bool = True
    """Whether the fingers' forces rise together, once all have landed or arrived."""
    approach_s: float = 1.0
    """After this time every finger counts as arrived [s]."""
    command_angular_weight: float = 0.003
    """Metres per radian in the fingers' least squares [m/rad]. With the rewards' 0.05 the turn that
    three joints cannot follow keeps the pads 10–30 mm away from their contacts."""
    hold_lead: float = 0.1
    """Most that a guided joint target runs ahead of its joint [rad]: no force is wound up against
    whatever stops a finger before it lands."""
    finger_damping: float = 1e-4
    """λ of the fingers' damped least squares [m²]."""
    finger_rate_limit: float = 3.0
    """Bound on the guided finger joint velocities [rad/s]."""
    arm_damping: float = 1e-4
    """λ of the arm's damped least squares [m²]."""

    guidance_speed: float = 0.08
    """v_max: speed of the guided pads towards their contacts [m/s]."""
    guidance_slowdown: float = 0.02
    """ε_p: distance to the contact below which the speed falls [m]."""
    guidance_return: float = 4.0
    """η: rate of return to the straight line [1/s]."""
    guidance_turn: float = 4.0
    """k_R: rate of alignment with the surface [1/s]."""
    angular_weight: float = 0.05
    """Metres per radian in the rewards' norms of twists [m/rad]."""

    lift_speed: float = 0.15
    """Speed of the scripted lift [m/s]."""
    lift_height: float = 0.15
    """Height at which the scripted lift stops [m]."""
    lift_ramp_s: float = 0.2
    """Time in which the lift's trapezoid reaches its speed [s]."""
    lift_delay_s: float = 0.5
    """Time from the change of stage to the first motion of the lift, in which the grip builds up
    [s]; 0 as published."""
    acquisition_s: float = 1.6
    """After this time two fingers suffice for the lift [s]."""
    acquisition_fingers: int = 2
    """Fingers that suffice then."""

    reach_weight: float = 3.0
    """Reward per tick of pads that move as the guidance says, before the lift."""
    reach_scale: float = 0.5
    """s of the reach reward [-]."""
    reach_floor: float = 0.02
    """ε of the reach reward [m/s]."""
    contact_weight: float = 1.0
    """Reward per tick and fingertip that touches the object."""
    lift_weight: float = 2.0
    """Reward per tick of a palm that rises as the script says, in the lift."""
    lift_reward_scale: float = 0.1
    """Width of the lift reward [m/s]."""
    action_rate_weight: float = -0.01
    """Times the squared change of the action between two ticks."""
    action_acceleration_weight: float = -0.005
    """Times the squared second difference of the action."""

    observer_gain: float = 50.0
    """K of the momentum observer [1/s]."""
    stall_speed: float = 0.1
    """Finger joint speed under which a torque counts as contact [rad/s]."""
    contact_torque: float = 0.03
    """Estimated external torque that counts as contact [N m]."""
    contact_ticks: int = 3
    """Ticks in a row before the observer reports a contact."""
    stop_margin: float = 0.03
    """Joints nearer than this to a stop are left out of the observer [rad]."""

    success_height: float = 0.10
    """Rise of the object that counts as lifted [m]."""
    success_hold_s: float = 0.5
    """How long the rise must last [s]."""
    success_slip: float = 0.03
    """Palm-frame displacement since lift onset that counts as a slip [m]."""

    def __post_init__(self):
        for name in ("control_dt", "episode_s", "lift_speed", "lift_height", "guidance_speed"):
            if not getattr(self, name) > 0:
                raise InputError(f"ClosingConfig.{name}", getattr(self, name), "a positive number")
        if self.grip_force < 0:
            raise InputError("ClosingConfig.grip_force", self.grip_force, "0 N or more")
        if not 0 <= self.residual_keep <= 1:
            raise InputError("ClosingConfig.residual_keep", self.residual_keep, "0 to 1")
        if self.lift_ramp_s * self.lift_speed > self.lift_height:
            raise InputError(
                "ClosingConfig.lift_ramp_s", self.lift_ramp_s, "at most lift_height / lift_speed"
            )
        if self.episode_ticks < 1:
            raise InputError("ClosingConfig.episode_s", self.episode_s, "one control tick or more")

    @property
    def episode_ticks(self) -> int:
        """Control ticks of an episode."""
        return round(self.episode_s / self.control_dt)


@dataclass(frozen=True)
class StartNoise:
    """What a reset draws anew: errors of the object's pose against the handoff, and physics."""

    offset_m: float = 0.005
    """Lateral object offset, uniform in ± this along x and y [m]."""
    angle_rad: float = 0.0
    """Object rotation about a random axis, uniform up to this [rad]."""
    friction: tuple[float, float] = (0.8, 0.8)
    """Range of the sliding friction [-]."""
    mass_scale: tuple[float, float] = (1.0, 1.0)
    """Range of the factor on the object's mass [-]."""

    def __post_init__(self):
        if not 0 <= self.offset_m <= MAX_OFFSET_M:
            raise InputError("StartNoise.offset_m", self.offset_m, f"0 to {MAX_OFFSET_M} m")
        if not 0 <= self.angle_rad <= MAX_ANGLE_RAD:
            raise InputError("StartNoise.angle_rad", self.angle_rad, f"0 to {MAX_ANGLE_RAD} rad")
        for name in ("friction", "mass_scale"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(f"StartNoise.{name}", (low, high), "0 < low <= high")
