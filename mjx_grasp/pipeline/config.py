"""Every number of the grasp as a whole, beside those of reaching and closing."""

from __future__ import annotations

from dataclasses import dataclass

from mjx_grasp.records.settings import NonNegative, Positive, PositiveOrNever, Settings, WholeNumber


@dataclass(frozen=True)
class ServoConfig(Settings):
    """How velocities of reaching become position targets of joint servos."""

    lead: Positive = 0.05
    """most that the integrated target runs ahead of its joint: what stops a joint winds up no force
    [rad]"""
    feed_forward: NonNegative = 1.0
    """share of a servo's lag at the commanded velocity that its target makes up for [-]"""


@dataclass(frozen=True)
class PoseFilterConfig(Settings):
    """How the readings of a tracker are smoothed, as far as they jitter."""

    agility: Positive = 2.5e-3
    """how quickly an object changes its velocity, as the spectral density of white acceleration:
    the less, the smoother and the later [m²/s³]"""
    turning: Positive = 0.25
    """and its angular velocity [rad²/s³]"""


@dataclass(frozen=True)
class GrasperConfig(Settings):
    """When a grasp goes from one phase to the next."""

    lost: PositiveOrNever = 0.050
    """distance of the pads' midpoint from that of the contacts from which a hand that closes goes
    back to reaching: the object is elsewhere [m]"""
    follows: WholeNumber = 3
    """times that it does so; from then on such a grasp has failed, for it may be the hand itself
    that pushes the object away. Without tries left it follows on [-]"""
    contact_s: Positive = 4.0
    """time for closing; without a lift by then the grasp has failed [s]"""
    retries: WholeNumber = 5
    """times that a grasp which was not reached or has failed is begun again, in the latter case
    away from its thumb's contact [-]"""
    avoided: NonNegative = 0.020
    """that far [m]"""
    dropped: PositiveOrNever = 0.060
    """displacement of the object in the palm since lift onset from which it is lost [m]"""
    most: NonNegative = 14.0
    """F to which weight and load may raise a grip that answers to load, where its own bound is
    lower: what the fingers can do, for heavy objects; light ones ask for less [N]"""
    hardest: NonNegative = 8.0
    """times the known weight with which the thumb begins to press at most: contacts that ask for
    more are not held by force [-]"""
    across_walls: NonNegative = 1.4
    """times the force by the known weight with which a thin wall is gripped at least once the lift
    is due, whatever a policy says: with less the object turns before it is felt [-]"""
    budget_per_weight: NonNegative = 4.0
    """times the known weight that the force budget of a policy is at most: what is light and
    pressed hard creeps out of the fingers while it is held; 0: all weights have the same [-]"""
    least_budget: Positive = 2.0
    """force budget that is left to it for the lightest objects [N]"""
    timeout_s: Positive = 30.0
    """from the start to the end of the lift [s]"""
    servo: ServoConfig = ServoConfig()
    """of the joints"""
    pose: PoseFilterConfig = PoseFilterConfig()
    """of the object"""
