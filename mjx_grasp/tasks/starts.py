"""Start states on the device: the handoffs of a dataset as a table that resets gather from."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.robot.interface import Measured
from mjx_grasp.robot.mjcf import joint_columns
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.physics import Truth, WorldParams, make_params
from mjx_grasp.sim.scene import Scene
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.tasks.robot_errors import RobotDraw


class StartTable(NamedTuple):
    """One row per handoff state."""

    object_index: Int[Array, " n"]
    """into the scene's objects"""
    qpos: Float[Array, "n nq"]
    ctrl: Float[Array, "n nu"]
    measured: Measured
    """what the robot would measure at the start"""
    truth: Truth
    """what the engine would report, without object offset"""
    targets: ThreePoints
    """contacts on the object's surface"""
    hull: Float[Array, "k v 3"]
    """convex hull vertices of each object, object frame, padded by repetition [m]"""
    lowest: Float[Array, " n"]
    """height of the object's lowest point over its origin, as it stands at the start [m]"""


class StartDraw(NamedTuple):
    """What is random about the start of an episode."""

    row: Int[Array, " w"]
    """Row of the start table."""
    offset: Float[Array, "w 2"]
    """Lateral object offset [m]."""
    rotation: Float[Array, "w 3"]
    """Object rotation as axis times angle, world frame [rad]."""
    friction: Float[Array, " w"]
    mass_scale: Float[Array, " w"]
    budget: Float[Array, " w"]
    """Force budget [N]."""
    robot: RobotDraw
    way: Float[Array, " w"] | None = None
    """Drawn evenly from 0 to 1, for where a task that begins before the handoff does, within what
    its curriculum allows; None for home. The closing task begins at the handoff [-]."""
    force: Float[Array, " w"] | None = None
    """With which the grip begins, per finger; None: with that of its settings [N]."""


def build_starts(scene: Scene, handoffs: HandoffSet, substeps: int) -> StartTable:
    """Builds the table on the host with native MuJoCo.

    Args:
        scene: The scene; it has to hold every object of the set.
        handoffs: The states.
        substeps: Physics steps per control tick, the width of `Measured.external_torque`.

    Raises:
        InputError: The set is empty, or an object of it is not in the scene, or has another
            shape there.
    """
    if len(handoffs.object_index) == 0:
        raise InputError("handoffs", "no states", "at least one start state")
    lookup = []
    for name, digest in zip(handoffs.object_names, handoffs.object_content_hash, strict=True):
        k = scene.object_index(name)
        if scene.objects[k].content_hash != digest:
            raise InputError(
                f"handoffs of {name}",
                f"states for another mesh ({digest[:12]})",
                f"states for the scene's mesh ({scene.objects[k].content_hash[:12]}): use the same "
                "--objects-dir, or make them again with python -m mjx_grasp.handoffs",
            )
        lookup.append(k)
    at, model = scene.addresses, scene.model
    n = len(handoffs.object_index)
    q = _robot_joints(scene, handoffs)
    qpos = np.zeros((n, model.nq))
    qpos[:, at.robot_qpos] = q
    qpos[:, at.object_qpos[:3]] = handoffs.object_pos
    qpos[:, at.object_qpos[3:]] = handoffs.object_quat
    ctrl = np.zeros((n, model.nu))
    ctrl[:, at.robot_ctrl] = q
    measured, truth = at_rest(scene, qpos, substeps)
    object_index = jnp.asarray(np.array(lookup)[handoffs.object_index], jnp.int32)
    hulls = jnp.asarray(_hulls(scene))
    each = (object_index, truth.object_quat)
    return StartTable(
        object_index=object_index,
        qpos=jnp.asarray(qpos, jnp.float32),
        ctrl=jnp.asarray(ctrl, jnp.float32),
        measured=measured,
        truth=truth,
        targets=ThreePoints(
            jnp.asarray(handoffs.target_pos, jnp.float32),
            jnp.asarray(handoffs.target_normal, jnp.float32),
        ),
        hull=hulls,
        # One after the other: all points of all states at once may be too many.
        lowest=jax.lax.map(lambda row: _lowest(hulls[row[0]], row[1]), each),
    )


def draw_starts(
    key: Array, worlds: int, noise: StartNoise, weights: Float[Array, " n"]
) -> StartDraw:
    """Draws start rows by weight, and the errors of `noise` uniformly.

    Args:
        key: Random key.
        worlds: How many.
        noise: Ranges.
        weights: Unnormalised probability of each row; see `balanced_weights`.
    """
    # One draw for everything: every call of a random function is a kernel of its own. What the
    # first eight columns hold does not change, so that a seed stands for the same starts for ever.
    u = jax.random.uniform(key, (worlds, 8))
    more = jax.random.uniform(jax.random.fold_in(key, 1), (worlds, 5))
    u = jnp.concatenate([u, more], axis=-1)
    cumulative = jnp.cumsum(weights)
    row = jnp.searchsorted(cumulative, u[:, 0] * cumulative[-1], method="compare_all")
    # A uniform axis: uniform height on the sphere, uniform angle around it.
    z, around = 2.0 * u[:, 3] - 1.0, 2.0 * jnp.pi * u[:, 4]
    flat = jnp.sqrt(jnp.maximum(1.0 - z**2, 0.0))
    axis = jnp.stack([flat * jnp.cos(around), flat * jnp.sin(around), z], axis=-1)

    def between(column: int, bounds: tuple[float, float]) -> Float[Array, " w"]:
        return bounds[0] + (bounds[1] - bounds[0]) * u[:, column]

    return StartDraw(
        row=row.clip(0, len(weights) - 1),
        offset=noise.offset_m * (2.0 * u[:, 1:3] - 1.0),
        rotation=axis * (noise.angle_rad * u[:, 5:6]),
        friction=between(6, noise.friction),
        mass_scale=between(7, noise.mass_scale),
        budget=between(8, noise.budget_n),
        robot=RobotDraw(
            stiffness=between(9, noise.robot.stiffness),
            latency=between(10, noise.robot.latency_s),
            friction=noise.robot.friction * (2.0 * u[:, 11] - 1.0),
            stream=(u[:, 12] * 2**24).astype(jnp.int32),
        ),
    )


def balanced_weights(object_index: Int[Array, " n"], objects: int) -> Float[Array, " n"]:
    """Row weights that make every object equally likely, whatever its number of states."""
    count = jnp.bincount(object_index, length=objects)
    return 1.0 / jnp.maximum(count, 1)[object_index]


def placed_object(starts: StartTable, draw: StartDraw, turned: bool) -> Float[Array, "w 7"]:
    """Object pose after the draw: shifted, turned about its origin, and set on the table again.

    Args:
        starts: The table.
        draw: The draw.
        turned: Whether the draw may hold rotations; without any, the height is left alone.

    Returns:
        Position [m] and quaternion, world frame.
    """
    pos, quat = starts.truth.object_pos[draw.row], starts.truth.object_quat[draw.row]
    pos = pos.at[:, :2].add(draw.offset)
    if turned:
        hull = starts.hull[starts.object_index[draw.row]]
        angle = jnp.linalg.norm(draw.rotation, axis=-1)
        axis = draw.rotation / jnp.maximum(angle, 1e-9)[:, None]
        quat = so3.quat_mul(so3.quat_from_axis_angle(axis, angle), quat)
        pos = pos.at[:, 2].add(starts.lowest[draw.row] - _lowest(hull, quat))
    return jnp.concatenate([pos, quat], axis=-1)


def _lowest(points: Float[Array, "*b v 3"], quat: Float[Array, "*b 4"]) -> Float[Array, "*b"]:
    """Height of the lowest of an object's points over its origin, the object turned so [m]."""
    up = so3.quat_to_mat(quat)[..., 2, :]
    # Written out, so that a GPU neither rounds the products nor keeps one of each point.
    x, y, z = (up[..., None, k] * points[..., k] for k in range(3))
    return jnp.min(x + y + z, axis=-1)


def draw_params(starts: StartTable, draw: StartDraw) -> WorldParams:
    """The engine's parameters for a draw."""
    return make_params(starts.object_index[draw.row], draw.friction, draw.mass_scale)


def _robot_joints(scene: Scene, handoffs: HandoffSet) -> np.ndarray:
    """The states' joints in the scene's robot order; joints fixed there have to be at zero."""
    columns = joint_columns(scene.robot)
    fixed = np.setdiff1d(np.arange(handoffs.q.shape[1]), columns)
    if len(fixed) and np.abs(handoffs.q[:, fixed]).max() > 1e-6:
        raise InputError(
            "SceneConfig.fix_idle_fingers",
            "handoff states with bent idle fingers",
            "idle fingers at zero, or fix_idle_fingers off",
        )
    return handoffs.q[:, columns]


def _hulls(scene: Scene) -> np.ndarray:
    """Hull vertices per object, padded to one length by repeating the first vertex."""
    hulls = [np.asarray(o.mesh.convex_hull.vertices, np.float32) for o in scene.objects]
    longest = max(map(len, hulls))
    return np.stack([np.concatenate([h, np.repeat(h[:1], longest - len(h), 0)]) for h in hulls])
