"""Whether a robot's description fits its MJCF."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.robot.description import FingerSpec, HandSpec, RobotSpec

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


def check_fit(spec: RobotSpec, path: Path) -> None:
    """Makes sure that everything the description names exists in the MJCF and fits it.

    Args:
        spec: What the description says.
        path: Its file, for the error.

    Raises:
        FileError: The MJCF does not compile.
        InputError: Something does not exist or fit; the message names the field.
    """
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
