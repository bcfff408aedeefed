"""What the package knows of a robot: which joints, bodies and sites play which part.

Another hand or arm is another description file; ``python -m mjx_grasp.robot.spec my_robot.yaml``
checks one and prints what it understood.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import tyro

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.robot.identity import RobotIdentity
from mjx_grasp.robot.reading import Section

_SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class FingerSpec:
    """One finger of the grasp. Names are those of the MJCF."""

    name: str
    role: str  # 'thumb' or 'wrap'
    joints: tuple[str, ...]  # from the root to the tip
    policy_joints: tuple[str, ...]  # those that the closing policy drives
    bodies: tuple[str, ...]  # links from the root to the tip
    tip_body: str  # the distal link
    tip_geom: str  # its only geom, which contact sensors watch
    tip_site: str  # the tip frame, in which all tip errors are measured
    pad_site: str  # centre of the pad; the pad's outward normal is the site's +x


@dataclass(frozen=True)
class HandSpec:
    """The hand. Axes are in the palm frame, which is the frame of ``palm_body``."""

    name: str
    palm_body: str
    palm_site: str
    fingers: tuple[FingerSpec, FingerSpec, FingerSpec]  # the thumb, then the two wraps
    joints: tuple[str, ...]  # all of the hand, model order
    open_posture: tuple[float, ...]  # rad, one per joint
    span: tuple[float, float]  # m, least and greatest distance of thumb and wraps
    scoring_friction: float  # friction coefficient of the heatmap's scores
    approach_axis: tuple[float, float, float]  # out of the palm
    opposing_axis: tuple[float, float, float]  # whose angle to the grasp axis is weighed
    velocity_limit: float  # rad/s, every joint

    @property
    def policy_joints(self) -> tuple[str, ...]:
        """Joints that the policy drives: thumb, first wrap, second wrap."""
        return tuple(joint for finger in self.fingers for joint in finger.policy_joints)

    @property
    def held_joints(self) -> tuple[str, ...]:
        """Joints that the policy leaves alone, model order."""
        driven = set(self.policy_joints)
        return tuple(joint for joint in self.joints if joint not in driven)


@dataclass(frozen=True)
class ArmSpec:
    """The arm."""

    name: str
    joints: tuple[str, ...]  # from the base to the flange
    policy_joints: tuple[str, ...]  # those that the closing policy drives
    home: tuple[float, ...]  # rad, one per joint
    velocity_limits: tuple[float, ...]  # rad/s, one per joint


@dataclass(frozen=True)
class RobotSpec:
    """Arm, hand, and the MJCF that both name things in."""

    name: str
    arm: ArmSpec
    hand: HandSpec
    mjcf: Path
    digest: str
    """SHA-256 of description and MJCF as they were read; fixing idle fingers leaves it."""

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
        return self.arm.home + self.hand.open_posture

    @property
    def velocity_limits(self) -> tuple[float, ...]:
        """Velocity limits, rad/s, one per joint."""
        return self.arm.velocity_limits + (self.hand.velocity_limit,) * len(self.hand.joints)

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


def load_robot(name: str | Path = "rizon4_hx5d20") -> RobotSpec:
    """Reads and validates a robot's description.

    Args:
        name: Name of a shipped robot, or path of a description file (``.yaml``); the MJCF it names
            is looked up beside it.

    Raises:
        FileError: The description or its MJCF is missing or cannot be read.
        InputError: The description is wrong in itself or does not fit its MJCF; the message names
            the field.
    """
    if str(name).endswith((".yaml", ".yml")):
        path = Path(name)
    else:
        path = asset_path("robot", f"{name}.yaml")
    spec = _read(Section.from_file(path))
    _check_against_model(spec, path)
    return spec


def _read(section: Section) -> RobotSpec:
    arm, hand = section.section("arm"), section.section("hand")
    name, mjcf = section.name("name"), section.path.parent / section.name("mjcf")
    arm_spec, hand_spec = _read_arm(arm), _read_hand(hand)
    for part in (section, arm, hand):
        part.done()
    if not mjcf.is_file():
        raise FileError(mjcf, "no such file", f"the MJCF that {section.path} names")
    # Neither comments nor how a checkout ends its lines make another robot.
    known = section.as_json().encode() + mjcf.read_bytes().replace(b"\r\n", b"\n")
    return RobotSpec(name, arm_spec, hand_spec, mjcf, hashlib.sha256(known).hexdigest())


def _read_arm(section: Section) -> ArmSpec:
    joints = section.names("joints")
    limits = section.numbers("velocity_limits", len(joints))
    if min(limits) <= 0:
        raise InputError(section.field("velocity_limits"), limits, "numbers above zero")
    return ArmSpec(
        name=section.name("name"),
        joints=joints,
        policy_joints=_subset(section, "policy_joints", joints),
        home=section.numbers("home", len(joints)),
        velocity_limits=limits,
    )


def _read_hand(section: Section) -> HandSpec:
    joints = section.names("joints")
    fingers = [_read_finger(part, joints) for part in section.sections("fingers")]
    roles = tuple(finger.role for finger in fingers)
    if roles != ("thumb", "wrap", "wrap"):
        raise InputError(section.field("fingers"), roles, "three fingers: thumb, wrap, wrap")
    for what in ("name", "tip_body", "tip_geom", "tip_site", "pad_site"):
        values = [getattr(finger, what) for finger in fingers]
        if len(set(values)) != len(values):
            raise InputError(section.field("fingers"), values, f"another {what} for each finger")
    shared = [joint for finger in fingers for joint in finger.joints]
    if len(set(shared)) != len(shared):
        raise InputError(section.field("fingers"), shared, "each joint in one finger only")
    low, high = section.numbers("span", 2)
    if not 0 < low < high:
        raise InputError(section.field("span"), (low, high), "0 < least < greatest, in m")
    thumb, first, second = fingers
    return HandSpec(
        name=section.name("name"),
        palm_body=section.name("palm_body"),
        palm_site=section.name("palm_site"),
        fingers=(thumb, first, second),
        joints=joints,
        open_posture=section.numbers("open_posture", len(joints)),
        span=(low, high),
        scoring_friction=section.number("scoring_friction", positive=True),
        approach_axis=_unit_axis(section, "approach_axis"),
        opposing_axis=_unit_axis(section, "opposing_axis"),
        velocity_limit=section.number("velocity_limit", positive=True),
    )


def _read_finger(section: Section, hand_joints: tuple[str, ...]) -> FingerSpec:
    joints = _subset(section, "joints", hand_joints)
    bodies = section.names("bodies")
    finger = FingerSpec(
        name=section.name("name"),
        role=section.name("role", among=("thumb", "wrap")),
        joints=joints,
        policy_joints=_subset(section, "policy_joints", joints),
        bodies=bodies,
        tip_body=section.name("tip_body", among=bodies),
        tip_geom=section.name("tip_geom"),
        tip_site=section.name("tip_site"),
        pad_site=section.name("pad_site"),
    )
    section.done()
    return finger


def _subset(section: Section, key: str, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Names that are all among the given ones, in the same order."""
    names = section.names(key)
    if names != tuple(joint for joint in joints if joint in names):
        raise InputError(
            section.field(key), names, "joints in this order out of " + ", ".join(joints)
        )
    return names


def _unit_axis(section: Section, key: str) -> tuple[float, float, float]:
    x, y, z = section.numbers(key, 3)
    if abs(math.hypot(x, y, z) - 1.0) > 1e-6:
        raise InputError(section.field(key), (x, y, z), "a vector of length 1")
    return x, y, z


def _check_against_model(spec: RobotSpec, path: Path) -> None:
    """Everything the description names exists in the MJCF and fits it."""
    try:
        model = mujoco.MjModel.from_xml_path(str(spec.mjcf))
    except ValueError as error:
        raise FileError(spec.mjcf, f"no MJCF that compiles ({error})", "a robot's MJCF") from error

    names = {
        "joint": [model.joint(i).name for i in range(model.njnt)],
        "actuator": [model.actuator(i).name for i in range(model.nu)],
        "body": [model.body(i).name for i in range(model.nbody)],
        "geom": [model.geom(i).name for i in range(model.ngeom)],
        "site": [model.site(i).name for i in range(model.nsite)],
    }

    def check(kind: str, name: str, field: str) -> None:
        if name not in names[kind]:
            raise InputError(f"{path}: {field}", name, f"a {kind} of {spec.mjcf.name}")

    for part, joints in (("arm", spec.arm.joints), ("hand", spec.hand.joints)):
        for joint in joints:
            check("joint", joint, f"{part}.joints")
    for kind in ("joint", "actuator"):
        if tuple(names[kind]) != spec.joints:
            raise InputError(
                f"{path}: arm.joints + hand.joints",
                spec.joints,
                f"the {kind}s of {spec.mjcf.name}, all, in its order: " + ", ".join(names[kind]),
            )
    check("body", spec.hand.palm_body, "hand.palm_body")
    check("site", spec.hand.palm_site, "hand.palm_site")
    for i, finger in enumerate(spec.hand.fingers):
        field = f"hand.fingers[{i}]"
        for body in finger.bodies:
            check("body", body, f"{field}.bodies")
        check("geom", finger.tip_geom, f"{field}.tip_geom")
        check("site", finger.tip_site, f"{field}.tip_site")
        check("site", finger.pad_site, f"{field}.pad_site")
        tip = model.body(finger.tip_body).id
        for kind, body in (
            ("tip_geom", model.geom(finger.tip_geom).bodyid[0]),
            ("tip_site", model.site(finger.tip_site).bodyid[0]),
            ("pad_site", model.site(finger.pad_site).bodyid[0]),
        ):
            if body != tip:
                found = f"{getattr(finger, kind)} on {model.body(body).name}"
                raise InputError(f"{path}: {field}.{kind}", found, f"one on {finger.tip_body}")
    _check_posture(model, spec.arm.joints, spec.arm.home, f"{path}: arm.home")
    _check_posture(model, spec.hand.joints, spec.hand.open_posture, f"{path}: hand.open_posture")


def _check_posture(
    model: mujoco.MjModel, joints: tuple[str, ...], posture: tuple[float, ...], field: str
) -> None:
    for name, angle in zip(joints, posture, strict=True):
        joint = model.joint(name)
        if joint.type[0] not in _SCALAR_JOINTS:
            raise InputError(f"{field} ({name})", "a free or ball joint", "a hinge or slide joint")
        low, high = joint.range
        if model.jnt_limited[joint.id] and not low <= angle <= high:
            raise InputError(f"{field} ({name})", angle, f"within [{low:.6g}, {high:.6g}]")


@dataclass(frozen=True)
class CheckConfig(CommandSettings):
    """Checks a robot description and prints what it says."""

    description: tyro.conf.Positional[str] = "rizon4_hx5d20"
    """name of a shipped description, or a description file"""


def main(config: CheckConfig) -> None:
    """The command."""
    spec = load_robot(config.description)
    hand = spec.hand
    print(f"{spec.name}: {spec.arm.name}, {len(spec.arm.joints)} joints, with {hand.name},")
    print(f"{len(hand.joints)} joints, of which the policy drives {', '.join(hand.policy_joints)}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(CheckConfig)))
