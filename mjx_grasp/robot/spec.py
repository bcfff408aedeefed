"""`python -m mjx_grasp.robot.spec`: reads and checks the description of a robot.

Another hand or arm is another description file; the command checks one and prints what it
understood.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import tyro
import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.command_line import parsed
from mjx_grasp.records.settings import CommandSettings, Settings, from_record
from mjx_grasp.records.strict_yaml import load_yaml
from mjx_grasp.robot.description import ArmSpec, HandSpec, Name, RobotSpec
from mjx_grasp.robot.fit import check_fit

_WHOLE = "description"
_WIDEST_M = 1.0


@dataclass(frozen=True)
class _Description(Settings):
    """What a description file holds."""

    name: Name
    mjcf: Name
    """its file, beside the description"""
    arm: ArmSpec
    hand: HandSpec


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
    check_fit(spec, path)
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
