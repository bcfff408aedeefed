"""How far the hand is from object and table, smoothly enough for the IK to move away.

The hand is a set of spheres on its links, the object a grid of signed distances to its convex
pieces. This guides the solver; whether a state is free of collisions is MuJoCo's to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import ConvexHull

from mjx_grasp.geometry.vectors import dot
from mjx_grasp.robot.spec import RobotSpec

if TYPE_CHECKING:
    from mjx_grasp.objects.model import Piece

_RESOLUTION = 40
# The grid reaches this far beyond the object; farther away nothing pushes.
_BORDER = 0.04


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


class DistanceGrid(NamedTuple):
    """Signed distances to an object on a regular grid in its frame; negative inside.

    Attributes:
        values: ``[n, n, n]`` in [m].
        origin: ``[3]`` the first grid point, [m].
        spacing: ``[3]`` between grid points, [m].
    """

    values: Float[np.ndarray, "n n n"]
    origin: Float[np.ndarray, " 3"]
    spacing: Float[np.ndarray, " 3"]


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


def distance_grid(pieces: Sequence[Piece]) -> DistanceGrid:
    """Signed distances to the union of an object's convex pieces.

    A hull's distance is that to its farthest face plane: exact inside and before a face, less
    than the true one beyond edges.

    Args:
        pieces: Spheres and hulls, in the object frame.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in pieces:
        if piece.kind == "sphere":
            points = np.asarray(piece.pos) + piece.radius * np.array([[-1.0] * 3, [1.0] * 3])
        else:
            points = np.asarray(piece.vertices)
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    low, high = low - _BORDER, high + _BORDER
    steps = [np.linspace(a, b, _RESOLUTION) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.full(len(grid), np.inf)
    for piece in pieces:
        if piece.kind == "sphere":
            distance = np.linalg.norm(grid - np.asarray(piece.pos), axis=1) - piece.radius
        else:
            planes = np.unique(ConvexHull(piece.vertices).equations.round(9), axis=0)
            distance = (grid @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        values = np.minimum(values, distance)
    shape = (_RESOLUTION,) * 3
    spacing = (high - low) / (_RESOLUTION - 1)
    arrays = (values.reshape(shape), low, spacing)
    return DistanceGrid(*(np.asarray(array, np.float32) for array in arrays))


def distance_and_gradient(
    grid: DistanceGrid, points: Float[Array, "s 3"]
) -> tuple[Float[Array, " s"], Float[Array, "s 3"]]:
    """Signed distance in [m] and its gradient at points of the object frame (trilinear)."""

    def distance(point):
        place = (point - grid.origin) / grid.spacing
        return map_coordinates(grid.values, list(place), order=1, mode="nearest")

    return jax.vmap(jax.value_and_grad(distance))(points)


def sphere_arms(spheres: HandSpheres, mat: Float[Array, "*b f 3 3"]) -> Float[Array, "*b s 3"]:
    """Centres of the spheres relative to the origins of their frames, world axes, [m].

    Args:
        spheres: The hand.
        mat: Rotations of the frames that carry spheres.
    """
    return dot(mat[..., spheres.frame, :, :], jnp.asarray(spheres.offset, mat.dtype)[:, None, :])


def outside_clearance(
    grid: DistanceGrid,
    points: Float[Array, "s 3"],
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
) -> tuple[Float[Array, " s"], Float[Array, "s 3"]]:
    """Distance in [m] of world points to the nearer of object and table, and the way off it.

    Args:
        grid: The object.
        points: Points in world, [m].
        p_wo: Object origin in world, [m].
        R_wo: Object rotation.
    """
    distance, slope = distance_and_gradient(grid, (points - p_wo) @ R_wo)
    height = points[:, 2]
    up = jnp.asarray([0.0, 0.0, 1.0], points.dtype)
    away = jnp.where((height < distance)[:, None], up, slope @ R_wo.T)
    return jnp.minimum(distance, height), away


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
