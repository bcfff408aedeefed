"""Small objects and start states made by hand, so that tests need no scan and no IK."""

import hashlib

import mujoco
import numpy as np
import trimesh

from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.objects.model import ObjectModel, Piece
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot

# Thumb and wraps face each other across 60 mm (robot facts, `lab_limits_W60mm`), along the world's
# y, 60 mm above (0.5, 0): the arm posture is a least-squares fit to that.
OPPOSED_ARM = (-0.5591, -0.9910, 0.3985, 1.4115, 0.8081, -0.1603, 0.7226)
OPPOSED_HAND = (-2.3, -1.222, -1.57, 0.679, 0.2, 0.771, 0.256, 0.444, 0.254, 0.853, 0.395, 0.231)


def _object(name, mesh, mass, inertia, pieces, com=(0.0, 0.0, 0.0)):
    digest = hashlib.sha256(f"{name} {mesh.extents} {mass}".encode()).hexdigest()
    return ObjectModel(
        name=name,
        source="parametric",
        mesh=mesh,
        mass=mass,
        com=np.asarray(com, float),
        inertia=np.asarray(inertia, float),
        pieces=pieces,
        outward_error_95=0.0,
        resting=(),
        content_hash=digest,
    )


def box(name="box", half=(0.03, 0.02, 0.045), mass=0.15, com=(0.0, 0.0, 0.0)):
    """A box as one hull."""
    mesh = trimesh.creation.box(extents=2 * np.asarray(half))
    square = np.asarray(half) ** 2
    inertia = mass / 3 * np.diag(square.sum() - square)
    hull = Piece("hull", np.zeros(3), 0.0, np.asarray(mesh.vertices))
    return _object(name, mesh, mass, inertia, (hull,), com)


def ball(name="ball", radius=0.027, mass=0.1):
    """A ball as one sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    piece = Piece("sphere", np.zeros(3), radius, np.zeros((0, 3)))
    return _object(name, mesh, mass, 0.4 * mass * radius**2 * np.eye(3), (piece,))


def dumbbell(name="dumbbell", radius=0.018, gap=0.05, mass=0.2):
    """Two balls and a bar, off-centre: several pieces, and an inertia with off-diagonals."""
    bar = trimesh.creation.box(extents=(gap, 0.012, 0.012))
    ends = [np.array([s * gap / 2, 0.003 * s, 0.0]) for s in (-1, 1)]
    balls = [trimesh.creation.icosphere(2, radius).apply_translation(e) for e in ends]
    inertia = np.diag([5e-5, 1.6e-4, 1.7e-4]) + 1e-5 * (np.eye(3, k=1) + np.eye(3, k=-1))
    pieces = (
        *(Piece("sphere", e, radius, np.zeros((0, 3))) for e in ends),
        Piece("hull", np.zeros(3), 0.0, np.asarray(bar.vertices)),
    )
    mesh = trimesh.util.concatenate([*balls, bar])
    return _object(name, mesh, mass, inertia, pieces, com=(0.004, 0.0, 0.001))


def turn_z(angle):
    """Rotation about z and its quaternion."""
    c, s = np.cos(angle), np.sin(angle)
    quat = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), quat


def opposed_posture(robot):
    """All joints in robot order."""
    hand = np.array(robot.hand.open_posture)
    hand[: len(OPPOSED_HAND)] = OPPOSED_HAND
    return np.concatenate([OPPOSED_ARM, hand])


def opposed_pads(robot):
    """Pad positions [3, 3] in the opposed posture, from MuJoCo."""
    model = robot_mjspec(robot).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = opposed_posture(robot)
    mujoco.mj_kinematics(model, data)
    return np.stack([data.site(f.pad_site).xpos for f in robot.hand.fingers])


def handoffs(objects, turns=(0.0, 0.1, -0.15)):
    """Each object between the opposed pads, the whole scene turned about the arm's base.

    The first joint turns about the world's z through the origin, so every state is a copy of the
    first one.
    """
    robot = load_robot()
    pads = opposed_pads(robot)
    rows = {name: [] for name in ("k", "pos", "quat", "q", "target", "normal")}
    for k, obj in enumerate(objects):
        height = -obj.mesh.bounds[0, 2]
        pos = np.array([0.5, 0.0, height])
        if obj.pieces[0].kind == "sphere" and len(obj.pieces) == 1:
            normal = (pads - pos) / np.linalg.norm(pads - pos, axis=-1, keepdims=True)
            target = pos + obj.pieces[0].radius * normal
        else:
            normal = np.array([[0, -1.0, 0], [0, 1, 0], [0, 1, 0]])
            target = pads.copy()
            target[:, 1] = normal[:, 1] * obj.mesh.bounds[1, 1]
        for angle in turns:
            R, quat = turn_z(angle)
            q = opposed_posture(robot)
            q[0] += angle
            rows["k"].append(k)
            rows["pos"].append(R @ pos)
            rows["quat"].append(quat)
            rows["q"].append(q)
            rows["target"].append(target @ R.T)
            rows["normal"].append(normal @ R.T)
    n = len(rows["k"])
    return HandoffSet(
        object_index=np.array(rows["k"], np.int32),
        object_pos=np.array(rows["pos"], np.float32),
        object_quat=np.array(rows["quat"], np.float32),
        q=np.array(rows["q"], np.float32),
        target_pos=np.array(rows["target"], np.float32),
        target_normal=np.array(rows["normal"], np.float32),
        score=np.ones(n, np.float32),
        residual=np.zeros((n, 3), np.float32),
        midpoint=np.zeros(n, np.float32),
        reached=np.zeros(n, bool),
        object_names=tuple(o.name for o in objects),
        object_content_hash=tuple(o.content_hash for o in objects),
    )


def box_handoffs_scene():
    """Robot, one box and its start states: the smallest complete task."""
    from mjx_grasp.sim.scene import build_scene

    objects = [box()]
    return build_scene(objects, load_robot()), handoffs(objects)
