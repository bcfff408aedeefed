"""What is said of a robot: which joints, bodies and sites of its MJCF play which part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import Finite, Positive, Settings, Several
from mjx_grasp.robot.identity import RobotIdentity

Name = Annotated[str, Several()]
Names = Annotated[tuple[Name, ...], Several(once=True)]


@dataclass(frozen=True)
class FingerSpec(Settings):
    """One finger of the grasp. Names are those of the MJCF."""

    name: Name
    role: Literal["thumb", "wrap"]
    joints: Names
    """from the root to the tip"""
    policy_joints: Names
    """those that the closing policy drives"""
    bodies: Names
    """links from the root to the tip"""
    tip_body: Name
    """the distal link"""
    tip_geom: Name
    """the only one there that touches, which contact sensors watch"""
    tip_site: Name
    """the tip frame, in which all tip errors are measured"""
    pad_site: Name
    """centre of the pad; the pad's outward normal is the site's +x"""


@dataclass(frozen=True)
class HandSpec(Settings):
    """The hand. Axes are in the palm frame, which is the frame of ``palm_body``."""

    name: Name
    palm_body: Name
    palm_site: Name
    """in its frame"""
    fingers: tuple[FingerSpec, ...]
    """the thumb, then the two wraps"""
    joints: Names
    """all of the hand, model order"""
    open_posture: tuple[Finite, ...]
    """one per joint [rad]"""
    span: Annotated[tuple[Positive, Positive], Several(ascending=True, strictly=True)]
    """least and greatest distance of thumb and wraps [m]"""
    scoring_friction: Positive
    """friction coefficient of the heatmap's scores [-]"""
    approach_axis: tuple[Finite, Finite, Finite]
    """out of the palm"""
    opposing_axis: tuple[Finite, Finite, Finite]
    """whose angle to the grasp axis is weighed"""
    velocity_limit: Positive
    """of every joint [rad/s]"""

    @property
    def policy_joints(self) -> tuple[str, ...]:
        """Joints that the policy drives: thumb, first wrap, second wrap."""
        return tuple(joint for finger in self.fingers for joint in finger.policy_joints)


@dataclass(frozen=True)
class ArmSpec(Settings):
    """The arm."""

    name: Name
    joints: Names
    """from the base to the flange"""
    policy_joints: Names
    """those that the closing policy drives"""
    home: tuple[Finite, ...]
    """one per joint [rad]"""
    velocity_limits: tuple[Positive, ...]
    """one per joint [rad/s]"""


@dataclass(frozen=True)
class RobotSpec:
    """Arm, hand, and the MJCF that both name things in."""

    name: str
    arm: ArmSpec
    hand: HandSpec
    mjcf: Path
    digest: str
    """SHA-256 of description and MJCF as they were read; fixing idle fingers and mounting the robot
    elsewhere leave it."""
    base_height: float = 0.0
    """of the base above the table top [m]"""

    @property
    def identity(self) -> RobotIdentity:
        """What files that are made with this robot say of it."""
        return RobotIdentity(self.name, self.digest)

    @property
    def joints(self) -> tuple[str, ...]:
        """All joints, model order: the arm's, then the hand's."""
        return self.arm.joints + self.hand.joints

    @property
    def home(self) -> tuple[float, ...]:
        """The arm at home with the hand open, rad, one per joint."""
        return tuple(map(float, self.arm.home + self.hand.open_posture))

    @property
    def velocity_limits(self) -> tuple[float, ...]:
        """Velocity limits, rad/s, one per joint."""
        return self.arm.velocity_limits + (self.hand.velocity_limit,) * len(self.hand.joints)

    def mounted(self, base_height: float) -> RobotSpec:
        """The same robot with its base that far above the table top [m], below it if negative."""
        return replace(self, base_height=base_height)

    def without_idle_fingers(self) -> RobotSpec:
        """The same robot with the joints of fingers that take no part in a grasp fixed at zero.

        Fewer degrees of freedom are faster to simulate. The MJCF stays; `robot_mjspec` drops the
        joints that are not named here.

        Raises:
            InputError: Such a joint is not at zero in the open posture.
        """
        active = {joint for finger in self.hand.fingers for joint in finger.joints}
        kept = [i for i, joint in enumerate(self.hand.joints) if joint in active]
        posture = dict(zip(self.hand.joints, self.hand.open_posture, strict=True))
        bent = {j: angle for j, angle in posture.items() if j not in active and angle != 0.0}
        if bent:
            raise InputError("hand.open_posture", bent, "idle fingers at zero, to be fixed there")
        hand = replace(
            self.hand,
            joints=tuple(self.hand.joints[i] for i in kept),
            open_posture=tuple(self.hand.open_posture[i] for i in kept),
        )
        return replace(self, hand=hand)
