"""Every number of the tasks beside their controller's (method §5 to §7)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Literal

from mjx_grasp.closing.config import ActionConfig, CloserConfig
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import (
    Finite,
    NonNegative,
    Positive,
    PositiveOrNever,
    Range,
    Settings,
    Share,
)
from mjx_grasp.tasks.curriculum import CurriculumConfig

MAX_OFFSET_M = 0.05
"""Largest object offset that a start may have [m]."""
MAX_ANGLE_RAD = 0.8
"""Largest object rotation that a start may have [rad]."""


@dataclass(frozen=True)
class RewardConfig(Settings):
    """Weights and scales of the reward terms (method §5)."""

    reach: Finite = 3.0
    """per tick of pads that move as the guidance says, before the lift"""
    reach_scale: Positive = 0.5
    """s of the reach reward [-]"""
    reach_floor: Positive = 0.02
    """ε of the reach reward [m/s]"""
    turn_weight: NonNegative = 0.05
    """of angular against linear velocity in the norms of twists [m/rad]"""
    contact: Finite = 1.0
    """per tick and fingertip that touches the object"""
    lift: Finite = 2.0
    """per tick of a palm that rises as the script says, in the lift"""
    lift_speed: Positive | None = None
    """of the palm that the lift reward asks for, 0.15 as published; None: the script's own at the
    time [m/s]"""
    lift_scale: Positive = 0.1
    """width of the lift reward [m/s]"""
    action_rate: Finite = -0.01
    """times the squared change of the action between two ticks"""
    action_acceleration: Finite = -0.005
    """times the squared second difference of the action"""
    held: Finite = 0.0
    """per tick in which the object stays where it was in the palm when the lift began, and per tick
    of the time for contact acquisition"""
    held_scale: Positive = 0.01
    """displacement in the palm at which that has fallen to 1/e [m]"""
    force: Finite = 0.0
    """times the mean finger force in the lift [1/N]"""
    over_budget: Finite = 0.0
    """times the mean finger force since lift onset beyond the force budget [1/N]"""
    spent: Finite = 0.0
    """times the fingers' mean force at a tick of the lift as a share of the force budget, at most
    1: so that light objects are pressed less than heavy ones [-]"""
    hard: Finite = 0.0
    """times the largest force on a finger beyond `hard_from`, at any time [1/N]"""
    hard_from: NonNegative = 8.0
    """force on one finger that counts as hard [N]"""
    way_left: Finite = 0.0
    """times how much nearer to their contacts the pads have come in the tick, mean; of an episode
    it is paid for the way alone, however long that takes [1/m]"""
    posture: Finite = 0.0
    """end to end: times how much nearer to the posture at the handoff the joints with actions have
    come in the tick, along the way from home and until the lift; straight at their contacts pads
    would go through the object [1/rad]"""
    posture_near: NonNegative = 0.7
    """distance from that posture, over all these joints, from which it is near enough [rad]"""


@dataclass(frozen=True)
class SuccessConfig(Settings):
    """What counts as a grasp that holds (method §7)."""

    height: Positive = 0.10
    """rise of the object that counts as lifted [m]"""
    hold_s: NonNegative = 0.5
    """how long the rise must last [s]"""
    slip: Positive = 0.03
    """palm-frame displacement since lift onset that counts as a slip [m]"""


@dataclass(frozen=True)
class ClosingTaskConfig(CloserConfig):
    """The closing task: its controller, rewards, success, and the time that it has."""

    episode_s: Positive = 4.0
    """time to close, lift and hold [s]"""
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    success: SuccessConfig = field(default_factory=SuccessConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episode_ticks < 1:
            raise InputError(self.name_of("episode_s"), self.episode_s, "one control tick or more")
        if self.reward.posture and not isinstance(self, EndToEndConfig):
            where = self.reward.name_of("posture")
            raise InputError(
                where, self.reward.posture, "0: the closing task begins at the handoff"
            )

    @property
    def episode_ticks(self) -> int:
        """Control ticks of an episode."""
        return round(self.episode_s / self.control_dt)


@dataclass(frozen=True)
class EndToEndConfig(ClosingTaskConfig):
    """The closing task from farther away: one policy reaches, closes and lifts (method §6)."""

    kind: Literal["end_to_end"] = "end_to_end"
    """by which files tell the tasks apart; the closing task has none"""
    episode_s: Positive = 9.0
    """time to reach, close, lift and hold [s]"""
    reach_s: NonNegative = 3.0
    """time for reaching, before that for contact acquisition begins [s]"""
    action: ActionConfig = field(
        default_factory=lambda: ActionConfig(arm_rate=0.5, residual="integrated")
    )
    observation: ObservationConfig = field(default_factory=lambda: ObservationConfig(targets=True))
    assisted: bool = False
    """whether guidance moves the fingers before the lift too, with the actions added as residuals,
    and the grip presses with those that have touched or arrived"""
    within: PositiveOrNever = math.inf
    """mean distance of the pads from their contacts within which guidance does, each then straight
    at its own, and the actions move the fingers alone elsewhere; inf: anywhere, along the lines on
    which the episode began [m]"""
    reach_rate: NonNegative | None = None
    """arm joint velocity at action 1 before the lift; None: as in the lift. Nothing else bounds it,
    while reaching keeps to the robot's velocity limits [rad/s]"""
    given_up: PositiveOrNever = math.inf
    """how far the object may be moved before the lift until an episode of a training ends; one
    that slips in the lift ends it too. inf: all go on to the end of their time [m]"""
    postures: Annotated[int, Range(2, 1000)] = 17
    """in which an episode may begin, on the line in joint space from each handoff to home, both
    included, evenly on each of its straight parts [-]"""
    raised: NonNegative = 0.0
    """by how much the palm goes straight up first on this line, as far as the arm can, over two
    fifths of the postures; 0: the line is straight, which leads through many objects [m]"""
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reach_s >= self.episode_s:
            least = f"less than episode_s ({self.episode_s:g})"
            raise InputError(self.name_of("reach_s"), self.reach_s, least)
        if math.isfinite(self.within) and not self.assisted:
            raise InputError(self.name_of("within"), self.within, "inf, or assisted")
        if math.isfinite(self.within) and self.reward.reach:
            expected = "0 with a finite `within`: where nothing guides, it pays for standing still"
            raise InputError(self.reward.name_of("reach"), self.reward.reach, expected)

    @property
    def controller(self) -> CloserConfig:
        """The closer's settings, its times counted from an episode's start."""
        own = {f.name: getattr(self, f.name) for f in fields(CloserConfig)}
        closer = CloserConfig(**own)
        later, approach = self.reach_s, self.grip.approach_s
        return replace(
            closer,
            stages=replace(self.stages, acquisition_s=later + self.stages.acquisition_s),
            grip=replace(self.grip, approach_s=None if approach is None else later + approach),
        )

    @property
    def closing(self) -> ClosingTaskConfig:
        """The closing task with the same grip, lift and success, where no policy reaches."""
        return ClosingTaskConfig(
            control_dt=self.control_dt,
            grip=self.grip,
            lift=self.lift,
            stages=self.stages,
            success=self.success,
        )


@dataclass(frozen=True)
class RobotErrors(Settings):
    """How the robot differs from its model."""

    stiffness: tuple[Positive, Positive] = (1.0, 1.0)
    """range of the factor on the position gains of the fingers [-]"""
    latency_s: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """range of the time that a command takes to arrive, in whole control periods [s]"""
    torque_std: NonNegative = 0.0
    """standard deviation of each reading of a finger's external torque [N m]"""
    torque_step: NonNegative = 0.0
    """by which these readings are quantised; 0 for none [N m]"""
    friction: Share = 0.0
    """the model of joint friction is off by up to ± this share [-]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "stiffness")
        check_range(self, "latency_s")

    @property
    def of_torque(self) -> bool:
        """Whether the readings of torque have any."""
        return max(self.torque_std, self.torque_step, self.friction) > 0


@dataclass(frozen=True)
class StartNoise(Settings):
    """What a reset draws anew: errors of the object's pose against the handoff, and physics."""

    offset_m: Annotated[float, Range(0, MAX_OFFSET_M)] = 0.005
    """lateral object offset, uniform in ± this along x and y [m]"""
    angle_rad: Annotated[float, Range(0, MAX_ANGLE_RAD)] = 0.0
    """object rotation about a random axis, uniform up to this [rad]"""
    friction: tuple[Positive, Positive] = (0.8, 0.8)
    """range of the sliding friction [-]"""
    mass_scale: tuple[Positive, Positive] = (1.0, 1.0)
    """range of the factor on the object's mass [-]"""
    budget_n: tuple[Positive, Positive] = (3.0, 3.0)
    """range of the force budget, for a policy that is given one [N]"""
    robot: RobotErrors = field(default_factory=RobotErrors)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("friction", "mass_scale", "budget_n"):
            check_range(self, name)


def check_range(settings: Settings, name: str) -> None:
    """Refuses a field that holds two bounds in the wrong order.

    Raises:
        InputError: It does.
    """
    low, high = getattr(settings, name)
    if not math.isfinite(high) or low > high:
        raise InputError(settings.name_of(name), (low, high), "the lower bound first")
