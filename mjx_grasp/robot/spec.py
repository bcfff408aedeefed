"""`python -m mjx_grasp.robot.spec`: which joints, bodies and sites of a robot play which part.

Another hand or arm is another description file; the command checks one and prints what it
understood.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import numpy as np
import tyro
import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.command_line import parsed
from mjx_grasp.records.settings import (
    CommandSettings,
    Finite,
    Positive,
    Settings,
    Several,
    from_record,
)
from mjx_grasp.records.strict_yaml import load_yaml
from mjx_grasp.robot.identity import RobotIdentity

_WHOLE = "description"
_WIDEST_M = 1.0
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


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
class _Description(Settings):
    """What a description file holds."""

    name: Name
    mjcf: Name
    """its file, beside the description"""
    arm: ArmSpec
    hand: HandSpec


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


def load_robot(name: str | Path = "rizon4_hx5d20") -> RobotSpec:
    """Reads and validates a robot's description.

    Args:
        name: Name of a shipped robot, or path of a description file (``.yaml``); the MJCF it names
            is looked up beside it.

    Raises:
        FileError: The description or its MJCF is missing or cannot be read.
        InputError: There is no such robot, or its description is wrong in itself or does not fit
            its MJCF; the message names the field.
    """
    if str(name).endswith((".yaml", ".yml")):
        path = Path(name)
    else:
        shipped = sorted(file.stem for file in asset_path("robot").glob("*.xml"))
        if name not in shipped:
            expected = f"{', '.join(shipped)}, or a description's file (.yaml)"
            raise InputError("robot", str(name), expected)
        path = asset_path("robot", f"{name}.yaml")
    spec = _read(path)
    _check_against_model(spec, path)
    return spec


def _read(path: Path) -> RobotSpec:
    try:
        described, known = _described(path.read_text())
    except InputError as error:
        field = error.field.removeprefix(_WHOLE).removeprefix(".") or "content"
        raise InputError(f"{path}: {field}", error.found, error.expected) from None
    except OSError as error:
        raise FileError(path, error.strerror or "no file", "a robot description") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        found = " ".join(str(error).split())
        raise FileError(path, f"no valid YAML ({found})", "a robot description") from error
    mjcf = path.parent / described.mjcf
    if not mjcf.is_file():
        raise FileError(mjcf, "no such file", f"the MJCF that {path} names")
    # Neither comments nor how a checkout ends its lines make another robot.
    digest = hashlib.sha256(known + mjcf.read_bytes().replace(b"\r\n", b"\n")).hexdigest()
    return RobotSpec(described.name, described.arm, described.hand, mjcf, digest)


@lru_cache(maxsize=8)  # a command asks several times, and to read YAML takes long
def _described(text: str) -> tuple[_Description, bytes]:
    """A description, checked in itself, and all that it says."""
    content = load_yaml(text)
    described = from_record(_Description, content, _WHOLE)
    _check_parts(described.arm, described.hand)
    return described, json.dumps(content, sort_keys=True).encode()


def _check_parts(arm: ArmSpec, hand: HandSpec) -> None:
    """What fields say of each other."""

    def check(holds: bool, field: str, found: object, expected: str) -> None:
        if not holds:
            raise InputError(field, found, expected)

    def check_joints(field: str, names: Sequence[str], joints: Sequence[str]) -> None:
        ordered = [joint for joint in joints if joint in names]
        among = "joints in this order out of " + ", ".join(joints)
        check(list(names) == ordered, field, names, among)

    for field, numbers, joints in (
        ("arm.home", arm.home, arm.joints),
        ("arm.velocity_limits", arm.velocity_limits, arm.joints),
        ("hand.open_posture", hand.open_posture, hand.joints),
    ):
        expected = f"{len(joints)} numbers"
        check(len(numbers) == len(joints), field, f"{len(numbers)} numbers", expected)
    check_joints("arm.policy_joints", arm.policy_joints, arm.joints)
    for name in ("approach_axis", "opposing_axis"):
        axis = getattr(hand, name)
        unit = abs(math.hypot(*axis) - 1.0) <= 1e-6
        check(unit, f"hand.{name}", axis, "a vector of length 1")
    for i, finger in enumerate(hand.fingers):
        field = f"hand.fingers[{i}]"
        check_joints(f"{field}.joints", finger.joints, hand.joints)
        check_joints(f"{field}.policy_joints", finger.policy_joints, finger.joints)
        among = "one of " + ", ".join(finger.bodies)
        check(finger.tip_body in finger.bodies, f"{field}.tip_body", finger.tip_body, among)
    roles = [finger.role for finger in hand.fingers]
    right = roles == ["thumb", "wrap", "wrap"]
    check(right, "hand.fingers", roles, "three fingers: thumb, wrap, wrap")
    for what in ("name", "tip_body", "tip_geom", "tip_site", "pad_site"):
        values = [getattr(finger, what) for finger in hand.fingers]
        check(len(set(values)) == 3, "hand.fingers", values, f"another {what} for each finger")
    wide = hand.span[1] <= _WIDEST_M
    check(wide, "hand.span", hand.span, f"metres, {_WIDEST_M:g} at most")
    shared = [joint for finger in hand.fingers for joint in finger.joints]
    once = len(set(shared)) == len(shared)
    check(once, "hand.fingers", shared, "each joint in one finger only")


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
    for name in spec.joints:
        _check_servo(model, name, path)
    check("body", spec.hand.palm_body, "hand.palm_body")
    check("site", spec.hand.palm_site, "hand.palm_site")
    _check_palm(model, spec.hand, path)
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
        _check_finger(model, finger, spec.hand.palm_body, f"{path}: {field}")
    _check_posture(model, spec.arm.joints, spec.arm.home, f"{path}: arm.home")
    _check_posture(model, spec.hand.joints, spec.hand.open_posture, f"{path}: hand.open_posture")


def _check_palm(model: mujoco.MjModel, hand: HandSpec, path: Path) -> None:
    """The palm's site is the palm body's frame, in which the description has its axes."""
    site, field = model.site(hand.palm_site), f"{path}: hand.palm_site"
    if site.bodyid[0] != model.body(hand.palm_body).id:
        found = f"{hand.palm_site} on {model.body(site.bodyid[0]).name}"
        raise InputError(field, found, f"one on {hand.palm_body}")
    if np.any(site.pos) or abs(site.quat[0]) < 1.0 - 1e-9:
        found = f"pos {site.pos.tolist()}, quat {site.quat.tolist()}"
        raise InputError(field, found, f"the frame of {hand.palm_body}")


def _check_finger(model: mujoco.MjModel, finger: FingerSpec, palm: str, field: str) -> None:
    """Its links are one beyond the other from the palm on, its joints move them, its tip feels."""
    before = palm
    for name in finger.bodies:
        body, above = model.body(name).id, []
        while body:
            body = int(model.body_parentid[body])
            above.append(model.body(body).name)
        if before not in above:
            raise InputError(f"{field}.bodies", name, f"a link beyond {before}")
        before = name
    for name in finger.joints:
        moved = model.body(model.joint(name).bodyid[0]).name
        if moved not in finger.bodies:
            expected = f"a joint of {', '.join(finger.bodies)}"
            raise InputError(f"{field}.joints", f"{name} of {moved}", expected)
    tip = model.body(finger.tip_body)
    geoms = range(tip.geomadr[0], tip.geomadr[0] + tip.geomnum[0])
    touching = [model.geom(k) for k in geoms if model.geom_contype[k] or model.geom_conaffinity[k]]
    if [geom.id for geom in touching] != [model.geom(finger.tip_geom).id]:
        found = ", ".join(geom.name or f"geom {geom.id}" for geom in touching) or "none"
        expected = f"{finger.tip_geom} alone, as contacts are felt with it"
        raise InputError(
            f"{field}.tip_geom", f"{found} to touch with on {finger.tip_body}", expected
        )


def _check_servo(model: mujoco.MjModel, name: str, path: Path) -> None:
    """The actuator of this name is a position servo of the joint of this name."""
    actuator, field = model.actuator(name), f"{path}: {name}"
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    if model.actuator_trntype[actuator.id] != joint or actuator.trnid[0] != model.joint(name).id:
        raise InputError(field, "an actuator of something else", "one of the joint of its name")
    gain, bias = float(actuator.gainprm[0]), float(actuator.biasprm[1])
    if not gain > 0 or bias != -gain:
        raise InputError(field, f"gain {gain:g} and bias {bias:g}", "a position servo (`position`)")


def _check_posture(
    model: mujoco.MjModel, joints: tuple[str, ...], posture: tuple[float, ...], field: str
) -> None:
    for name, angle in zip(joints, posture, strict=True):
        joint = model.joint(name)
        if joint.type[0] != _HINGE:
            kind = mujoco.mjtJoint(joint.type[0]).name.removeprefix("mjJNT_").lower()
            raise InputError(f"{field} ({name})", f"a {kind} joint", "a hinge")
        if not model.jnt_limited[joint.id]:
            raise InputError(f"{field} ({name})", "a joint without limits", "a `range` in the MJCF")
        low, high = joint.range
        if not low <= angle <= high:
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
    run_command(lambda: main(parsed(CheckConfig, None)))
