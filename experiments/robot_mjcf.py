"""From the robot's facts file to its MJCF: rewrites the one that is shipped.

  python experiments/robot_mjcf.py

The MJCF holds the robot alone; the facts file says which geoms collide. Every byte of it is part of
the robot's digest, by which policies and start states know their robot: the header too stays.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import tyro
import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import CommandSettings

HAND_BIT = 1
ARM_BIT = 2
OBJECT_BIT = 4
TABLE_BIT = 8

_NAME = "rizon4_hx5d20"
_FOOT = ("base", "link1")
_SEGMENTS = ("root", "proximal", "medial", "tip")

Facts = Mapping[str, Any]


def _numbers(values: int | float | Iterable[int | float]) -> str:
    values = values if isinstance(values, Iterable) else (values,)
    return " ".join(f"{value:.9g}" for value in values)


def _default(parent: ET.Element, name: str, **elements: Mapping[str, str]) -> ET.Element:
    """A default class that sets the attributes of the given elements."""
    node = ET.SubElement(parent, "default", {"class": name})
    for tag, attributes in elements.items():
        ET.SubElement(node, tag, dict(attributes))
    return node


def _bits(contype: int, conaffinity: int) -> dict[str, str]:
    return {"contype": str(contype), "conaffinity": str(conaffinity)}


def _add_defaults(root: ET.Element, settings: Facts) -> None:
    contact, rgba, hand = settings["contact"], settings["rgba"], settings["hand"]
    robot = _default(
        ET.SubElement(root, "default"),
        "robot",
        geom={
            "type": "capsule",
            "condim": str(contact["condim"]),
            "friction": _numbers(contact["friction"]),
            "solref": _numbers(contact["solref"]),
            "solimp": _numbers(contact["solimp"]),
        },
        site={"size": "0.003", "group": "4"},
    )
    arm_geom = {"rgba": _numbers(rgba["arm"])}
    arm = _default(robot, "arm", geom=arm_geom | _bits(ARM_BIT, OBJECT_BIT | TABLE_BIT))
    _default(arm, "foot", geom=_bits(0, OBJECT_BIT))
    _default(
        robot, "mount", geom={"type": "cylinder", "rgba": _numbers(rgba["mount"])} | _bits(0, 0)
    )
    fingers = _default(
        robot,
        "hand",
        geom={"rgba": _numbers(rgba["finger"])}
        | _bits(HAND_BIT, HAND_BIT | OBJECT_BIT | TABLE_BIT),
        joint={key: _numbers(hand[key]) for key in ("armature", "damping", "frictionloss")},
        position={
            "kp": _numbers(hand["kp"]),
            "kv": _numbers(hand["kv"]),
            "forcerange": _numbers((-hand["torque_limit"], hand["torque_limit"])),
        },
    )
    _default(fingers, "palm", geom={"type": "box", "rgba": _numbers(rgba["palm"])})
    for name in ("thumb_tip", "index_tip", "middle_tip", "other_tip"):
        _default(fingers, name, geom={"rgba": _numbers(rgba[name])})


def _add_body(parent: ET.Element, body: Facts, childclass: str | None = None) -> ET.Element:
    """The body with pose and inertia; MuJoCo's identity pose is left away."""
    attributes = {"name": body["body"]}
    if any(body["pos"]):
        attributes["pos"] = _numbers(body["pos"])
    if any(body["quat"][1:]):
        attributes["quat"] = _numbers(body["quat"])
    if childclass:
        attributes["childclass"] = childclass
    # The drives carry the weight of every link, so that none sags from its commanded posture.
    node = ET.SubElement(parent, "body", attributes | {"gravcomp": "1"})
    ET.SubElement(
        node,
        "inertial",
        {
            "mass": _numbers(body["mass"]),
            "pos": _numbers(body["com"]),
            "quat": _numbers(body["inertia_quat"]),
            "diaginertia": _numbers(body["diaginertia"]),
        },
    )
    return node


def _add_joint(node: ET.Element, joint: Facts, **more: str) -> None:
    """The hinge and its limits."""
    attributes = {"name": joint["name"], "axis": _numbers(joint["axis"])}
    ET.SubElement(node, "joint", attributes | {"range": _numbers(joint["range"])} | more)


def _add_shapes(node: ET.Element, name: str, shapes: list[Facts], geom_class: str | None) -> None:
    """One geom per shape; several shapes of one link are numbered."""
    for k, shape in enumerate(shapes):
        attributes = {"name": name if len(shapes) == 1 else f"{name}_{k}"}
        if geom_class:
            attributes["class"] = geom_class
        if shape["type"] == "box":
            attributes["pos"] = _numbers(shape["pos"])
            attributes["size"] = _numbers(shape["half_size"])
        else:
            attributes["fromto"] = _numbers(shape["fromto"])
            attributes["size"] = _numbers(shape["radius"])
        ET.SubElement(node, "geom", attributes)


def _add_position(
    actuators: ET.Element, joint: Facts, limits: Mapping[str, str], default_class: str
) -> None:
    ET.SubElement(
        actuators,
        "position",
        {"class": default_class, "name": joint["name"], "joint": joint["name"]}
        | {"ctrlrange": _numbers(joint["range"])}
        | dict(limits),
    )


def _add_arm(worldbody: ET.Element, actuators: ET.Element, facts: Facts) -> ET.Element:
    """The arm with its mount; returns the mount's element, which carries the hand."""
    settings = facts["settings"]["arm"]
    nodes = {"world": worldbody}
    driven = 0
    for body in facts["arm"]["bodies"]:
        name, parent = body["body"], body["parent"]
        node = _add_body(nodes[parent], body, "arm" if parent == "world" else None)
        nodes[name] = node
        if joint := body.get("joint"):
            _add_joint(node, joint, armature=_numbers(settings["armature"][driven]))
            limit = joint["torque_limit"]
            gains = {key: _numbers(settings[key][driven]) for key in ("kp", "kv")}
            _add_position(
                actuators, joint, gains | {"forcerange": _numbers((-limit, limit))}, "arm"
            )
            driven += 1
        _add_shapes(node, f"{name}_hull", body["shapes"], "foot" if name in _FOOT else None)
    mount = facts["mount"]
    node = _add_body(
        nodes[mount["parent"]],
        mount
        | {
            "quat": (1, 0, 0, 0),
            "com": (0, 0, mount["thickness"] / 2),
            "inertia_quat": (1, 0, 0, 0),
        },
    )
    plate = {"name": "mount_plate", "class": "mount"}
    plate["size"] = _numbers((mount["radius"], mount["thickness"] / 2))
    plate["pos"] = _numbers((0, 0, mount["thickness"] / 2))
    ET.SubElement(node, "geom", plate)
    return node


def _finger_links(facts: Facts) -> dict[str, list[str]]:
    """Bodies of each finger from its root to its tip."""
    links: dict[str, list[str]] = {}
    for body in facts["hand"]["bodies"]:
        if finger := body.get("finger"):
            links.setdefault(finger, []).append(body["body"])
    return links


def _add_hand(mount: ET.Element, actuators: ET.Element, facts: Facts) -> None:
    tip = facts["hand"]["fingertip"]
    coloured = {name for name in facts["settings"]["rgba"] if name.endswith("_tip")}
    links = _finger_links(facts)
    nodes = {facts["mount"]["body"]: mount}
    for body in facts["hand"]["bodies"]:
        name, finger = body["body"], body.get("finger")
        node = _add_body(nodes[body["parent"]], body, None if finger else "hand")
        nodes[name] = node
        if finger is None:
            _add_shapes(node, "palm", body["shapes"], "palm")
            ET.SubElement(node, "site", {"name": "palm_site"})
            continue
        _add_joint(node, body["joint"])
        _add_position(actuators, body["joint"], {}, "hand")
        segment = f"{finger}_{_SEGMENTS[links[finger].index(name)]}"
        if segment.endswith("_tip"):
            geom_class = segment if segment in coloured else "other_tip"
            _add_shapes(node, segment, body["shapes"], geom_class)
            for site in ("tip", "pad"):
                place = {"name": f"{finger}_{site}_site", "pos": _numbers(tip[f"{site}_pos"])}
                ET.SubElement(node, "site", place)
        else:
            _add_shapes(node, segment, body["shapes"], None)


def _add_excludes(root: ET.Element, facts: Facts) -> None:
    """Pairs of the hand that overlap by construction or cannot harm."""
    palm = facts["hand"]["bodies"][0]["body"]
    mount = facts["mount"]
    pairs = [(mount["parent"], palm), (mount["body"], palm)]
    for links in _finger_links(facts).values():
        pairs += [(palm, link) for link in links[:-1]]
        pairs += combinations(links, 2)
    contact = ET.SubElement(root, "contact")
    for body1, body2 in pairs:
        ET.SubElement(contact, "exclude", {"body1": body1, "body2": body2})


def _header(facts: Facts) -> str:
    lines = [
        "Flexiv Rizon 4 with the ROBOTIS HX5-D20 rev1 right hand; the robot alone.",
        f"Built from {_NAME}_facts.yaml by `python -m mjx_grasp.robot.mjcf`: change it there.",
        "Units m, kg, rad, N m. Sources of the numbers and their licences:",
    ]
    for source in facts["sources"]:
        lines += [
            f"  {source['id']}: {source['what']}",
            f"    {source['from']} ({source['licence']})",
        ]
    return "<!--\n" + "\n".join(f"  {line}" for line in lines) + "\n-->\n"


def build_mjcf(facts: Facts) -> str:
    """The robot's MJCF, as text.

    Args:
        facts: Content of the facts file: sources, arm, mount, hand, settings.

    Returns:
        A model with one position actuator per joint, named and ordered like the joints.
    """
    root = ET.Element("mujoco", {"model": _NAME})
    ET.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    _add_defaults(root, facts["settings"])
    worldbody = ET.SubElement(root, "worldbody")
    actuators = ET.Element("actuator")
    mount = _add_arm(worldbody, actuators, facts)
    _add_hand(mount, actuators, facts)
    _add_excludes(root, facts)
    root.append(actuators)
    ET.indent(root)
    return _header(facts) + ET.tostring(root, encoding="unicode") + "\n"


def shipped_facts() -> dict[str, Any]:
    """Content of the facts file that is shipped with the package."""
    return yaml.safe_load(asset_path("robot", f"{_NAME}_facts.yaml").read_text())


@dataclass(frozen=True)
class RebuildConfig(CommandSettings):
    """Rewrites the shipped MJCF from the shipped facts."""

    out: Path | None = None
    """where to write; over the shipped file by default"""


def main(config: RebuildConfig) -> None:
    """The command."""
    shipped = asset_path("robot", f"{_NAME}_facts.yaml").with_name(f"{_NAME}.xml")
    path = config.out or shipped
    with replacing(path) as temporary:
        temporary.write_text(build_mjcf(shipped_facts()))
    print(f"wrote {path}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(RebuildConfig, description=__doc__)))
