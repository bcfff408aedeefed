"""The hand as a set of spheres on its links: a shape whose distances are smooth and cheap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.vectors import dot
from mjx_grasp.robot.spec import RobotSpec


class HandSpheres(NamedTuple):
    """Spheres that follow frames of the hand.

    Attributes:
        frame: ``[s]`` index of the frame each is fixed to.
        offset: ``[s, 3]`` its centre in that frame, [m].
        radius: ``[s]`` in [m].
        apart: ``[s, s]`` whether two spheres must not overlap.
    """

    frame: Int[np.ndarray, " s"]
    offset: Float[np.ndarray, "s 3"]
    radius: Float[np.ndarray, " s"]
    apart: Bool[np.ndarray, "s s"]


def hand_spheres(
    model: mujoco.MjModel,
    robot: RobotSpec,
    joint_qpos: Int[np.ndarray, " joints"],
    frames: Sequence[str],
) -> HandSpheres:
    """Spheres inside the hand's collision shapes: two per capsule, a grid of them per box.

    Pairs that overlap at the open posture are neighbours whose simplified shapes overlap always.
    Joints between a shape and the nearest of the frames above it are taken as held at the open
    posture.

    Args:
        model: The robot.
        robot: Its description.
        joint_qpos: Addresses of the robot's joints in qpos.
        frames: Bodies that move on their own, the palm among them.
    """
    data = mujoco.MjData(model)
    data.qpos[joint_qpos] = robot.home
    mujoco.mj_kinematics(model, data)
    bodies = [model.body(name).id for name in frames]
    frame, offset, radius, owner, centre = [], [], [], [], []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        while body not in bodies and body != 0:
            body = int(model.body_parentid[body])
        if body == 0:
            continue
        centres, size = _inner_spheres(model.geom_type[geom], model.geom_size[geom])
        world = data.geom_xpos[geom] + centres @ data.geom_xmat[geom].reshape(3, 3).T
        local = (world - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        frame += [bodies.index(body)] * len(centres)
        offset.append(local)
        radius += [size] * len(centres)
        owner += [int(model.geom_bodyid[geom])] * len(centres)
        centre.append(world)
    at, radii = np.concatenate(centre), np.array(radius)
    gap = np.linalg.norm(at[:, None] - at, axis=-1) - radii[:, None] - radii
    apart = _may_collide(model)[np.ix_(owner, owner)] & (gap > 0)
    return HandSpheres(np.array(frame), np.concatenate(offset), radii, apart)


def _may_collide(model: mujoco.MjModel) -> np.ndarray:
    """Which pairs of bodies the model checks against each other."""
    free = ~np.eye(model.nbody, dtype=bool)
    children = np.arange(1, model.nbody)
    excluded = [(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature]
    for a, b in [*zip(children, model.body_parentid[1:], strict=True), *excluded]:
        free[a, b] = free[b, a] = False
    return free


def _inner_spheres(kind: int, size: np.ndarray) -> tuple[np.ndarray, float]:
    """Centres and radius of spheres that fill a shape, in its frame."""
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        radius = float(size.min())
        steps = [np.linspace(radius - s, s - radius, round(s / radius)) for s in size]
        return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3), radius
    return np.zeros((1, 3)), float(size[0])


def sphere_arms(spheres: HandSpheres, mat: Float[Array, "*b f 3 3"]) -> Float[Array, "*b s 3"]:
    """Centres of the spheres relative to the origins of their frames, world axes, [m].

    Args:
        spheres: The hand.
        mat: Rotations of the frames that carry spheres.
    """
    return dot(mat[..., spheres.frame, :, :], jnp.asarray(spheres.offset, mat.dtype)[:, None, :])


def own_clearance(
    spheres: HandSpheres, points: Float[Array, "s 3"]
) -> tuple[Float[Array, " s"], Float[Array, "s 3"]]:
    """Distance in [m] of each sphere's centre to the nearest other sphere, and the way off it.

    Args:
        spheres: The hand.
        points: Centres of its spheres, [m].
    """
    between = points[:, None, :] - points[None, :, :]
    length = jnp.sqrt(dot(between, between) + 1e-12)
    gap = jnp.where(spheres.apart, length - np.asarray(spheres.radius, np.float32), jnp.inf)
    nearest = jnp.argmin(gap, axis=1)
    rows = jnp.arange(len(points))
    distance = jnp.minimum(gap[rows, nearest], 1.0)
    return distance, between[rows, nearest] / length[rows, nearest, None]
