"""The chains of joints between the world and some frames of a MuJoCo model, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from mjx_grasp.errors import InputError

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True, eq=False)
class Chains:
    """n joints on the chains to F frames, the joints ordered by depth; q is the configuration.

    Node 0 is the world, node k + 1 the frame that joint k moves. With R, p the parent node's
    rotation and origin and s = q − q0, the joint's node has

    - hinge: R' = R (fixed + cos s · cosine + sin s · sine), p' = p + R anchor − R' offset;
    - slide: R' = R fixed, p' = p + R (anchor + s · axis) − R' offset.
    """

    frame_names: tuple[str, ...]
    joint_names: tuple[str, ...]  # every hinge and slide of the model, in the order of q
    column: np.ndarray  # [n] index of the joint into q
    reference: np.ndarray  # [n] q0, the joint's position in the reference configuration
    parent: np.ndarray  # [n] node
    hinge: np.ndarray  # [n] bool
    fixed: np.ndarray  # [n,3,3]
    cosine: np.ndarray  # [n,3,3]
    sine: np.ndarray  # [n,3,3]
    axis: np.ndarray  # [n,3] the joint's axis in the parent node
    anchor: np.ndarray  # [n,3] the joint's anchor in the parent node
    offset: np.ndarray  # [n,3] the joint's anchor in its own node
    levels: tuple[slice, ...]  # the joints of each depth; their parents are the level before
    frame_node: np.ndarray  # [F] node that carries the frame
    frame_pos: np.ndarray  # [F,3] the frame in its node
    frame_mat: np.ndarray  # [F,3,3]
    moves: np.ndarray  # [F,n] whether the joint moves the frame


@dataclass(frozen=True)
class _Place:
    """A frame in the node that carries it."""

    node: int
    pos: np.ndarray
    mat: np.ndarray

    def then(self, pos: np.ndarray, quat: np.ndarray) -> _Place:
        """The frame at this pose (w-x-y-z) in the present one."""
        return _Place(self.node, self.pos + self.mat @ pos, self.mat @ _matrix(quat))


def _matrix(quat: np.ndarray) -> np.ndarray:
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)


def _joints_of(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _bodies_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the first below the world down to this one."""
    chain: list[int] = []
    while body != 0:
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    return chain


def _joints_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Joints between the world and a body, the world's end first."""
    return [joint for link in _bodies_to(model, body) for joint in _joints_of(model, link)]


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, field: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        raise InputError(f"Kinematics.from_model, {field}", name, f"one of the model's {field}")
    return found


def _joint_row(model: mujoco.MjModel, joint: int, place: _Place) -> dict[str, object]:
    """Constants of a joint on a body whose frame, before this joint, is at ``place``."""
    local = model.jnt_axis[joint]
    along = np.outer(local, local)
    cross = np.cross(local, np.eye(3)).T  # cross @ v = local × v
    hinge = model.jnt_type[joint] == _HINGE
    return {
        "reference": model.qpos0[model.jnt_qposadr[joint]],
        "parent": place.node,
        "hinge": hinge,
        "fixed": place.mat @ (along if hinge else np.eye(3)),
        "cosine": place.mat @ (np.eye(3) - along if hinge else np.zeros((3, 3))),
        "sine": place.mat @ (cross if hinge else np.zeros((3, 3))),
        "axis": place.mat @ local,
        "anchor": place.pos + place.mat @ model.jnt_pos[joint],
        "offset": model.jnt_pos[joint].copy(),
    }


def compile_chains(
    model: mujoco.MjModel, sites: Sequence[str] = (), bodies: Sequence[str] = ()
) -> Chains:
    """The chains to the named sites and bodies, in this order.

    Raises:
        InputError: A name is unknown, nothing is asked for, or a free or ball joint is in a
            frame's chain.
    """
    identity = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    frames: list[tuple[str, int, tuple[np.ndarray, np.ndarray]]] = []  # name, body, pose in it
    for name in sites:
        site = _id(model, mujoco.mjtObj.mjOBJ_SITE, name, "sites")
        pose = model.site_pos[site].copy(), model.site_quat[site].copy()
        frames.append((name, int(model.site_bodyid[site]), pose))
    for name in bodies:
        frames.append((name, _id(model, mujoco.mjtObj.mjOBJ_BODY, name, "bodies"), identity))
    if not frames:
        raise InputError("Kinematics.from_model", "no frame", "at least one site or body")

    depth: dict[int, int] = {}
    for name, body, _ in frames:
        for level, joint in enumerate(_joints_to(model, body)):
            if model.jnt_type[joint] not in (_HINGE, _SLIDE):
                expected = "a frame that hinges and slides alone carry"
                raise InputError(f"Kinematics.from_model, {name}", "a free or ball joint", expected)
            depth[joint] = level
    order = sorted(depth, key=lambda joint: (depth[joint], joint))
    node = {joint: k + 1 for k, joint in enumerate(order)}

    # Parents have smaller body ids: one sweep places every body and meets every joint.
    places = {0: _Place(0, np.zeros(3), np.eye(3))}
    rows: dict[int, dict[str, object]] = {}
    links = {link for _, end, _ in frames for link in _bodies_to(model, end)}
    for body in sorted(links):
        above = places[int(model.body_parentid[body])]
        place = above.then(model.body_pos[body], model.body_quat[body])
        for joint in _joints_of(model, body):
            rows[joint] = _joint_row(model, joint, place)
            place = _Place(node[joint], np.zeros(3), np.eye(3))
        places[body] = place
    columns = [j for j in range(model.njnt) if model.jnt_type[j] in (_HINGE, _SLIDE)]
    depths = [depth[joint] for joint in order]
    ends = [0, *np.cumsum(np.bincount(depths))] if order else [0]
    placed = [places[body].then(*pose) for _, body, pose in frames]

    def stacked(key: str, *shape: int) -> np.ndarray:
        return np.array([rows[joint][key] for joint in order]).reshape(len(order), *shape)

    return Chains(
        frame_names=tuple(name for name, _, _ in frames),
        joint_names=tuple(model.joint(joint).name for joint in columns),
        # Indices of 32 bits: with 64, JAX 0.11 mixes both widths up where x64 is switched.
        column=np.array([columns.index(joint) for joint in order], np.int32),
        reference=stacked("reference"),
        parent=stacked("parent").astype(np.int32),
        hinge=stacked("hinge").astype(bool),
        fixed=stacked("fixed", 3, 3),
        cosine=stacked("cosine", 3, 3),
        sine=stacked("sine", 3, 3),
        axis=stacked("axis", 3),
        anchor=stacked("anchor", 3),
        offset=stacked("offset", 3),
        levels=tuple(slice(int(a), int(b)) for a, b in pairwise(ends)),
        frame_node=np.array([place.node for place in placed], np.int32),
        frame_pos=np.array([place.pos for place in placed]),
        frame_mat=np.array([place.mat for place in placed]),
        moves=np.array(
            [[joint in _joints_to(model, body) for joint in order] for _, body, _ in frames]
        ).reshape(len(frames), len(order)),
    )
