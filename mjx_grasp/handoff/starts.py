"""Which grasp-like configurations the IK starts from: a library of them, and the choice."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.vectors import dot, unit
from mjx_grasp.handoff.clearance import DistanceGrid, outside_clearance
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.robot.arrays import RobotArrays
from mjx_grasp.robot.postures import draw_postures

# A difference of pad directions counts as much as tips this far off.
_DIRECTION_SCALE = 0.05
_QUERY_TILE = 64
_PER_VARIANT = 16
# What a sphere of the hand lacks in clearance, once the tips are where they shall be, counts as
# much as tips this many times as far off.
_PENETRATION_WEIGHT = 5.0


class StartLibrary(NamedTuple):
    """Configurations and where they put tips and pads.

    Attributes:
        q: ``[l, joints]`` in [rad].
        features: ``[l, 18]`` tip positions in [m], pad directions scaled to [m]; world.
        half_squares: ``[l]`` half the squared lengths of the features, [m²].
    """

    q: Float[np.ndarray, "l joints"]
    features: Float[np.ndarray, "l 18"]
    half_squares: Float[np.ndarray, " l"]


def _features(tips, directions):
    return jnp.concatenate(
        [
            tips.reshape(*tips.shape[:-2], 9),
            _DIRECTION_SCALE * directions.reshape(*tips.shape[:-2], 9),
        ],
        axis=-1,
    )


def build_library(
    arrays: RobotArrays, size: int, sampling: SamplingConfig, seed: int
) -> StartLibrary:
    """Draws configurations about to grasp something in the object area, and their features.

    Args:
        arrays: The robot.
        size: Configurations wanted.
        sampling: The object area.
        seed: Of the draw.

    Raises:
        InputError: The robot does not reach the object area.
    """
    q = draw_postures(arrays, size, sampling.x_range, sampling.y_range, seed)

    @jax.jit
    @jax.vmap
    def features(q):
        pos, mat = arrays.kinematics.forward(q)
        return _features(pos[:3], mat[3:6, :, 0])

    rows = np.asarray(features(q))
    return StartLibrary(q, rows, 0.5 * np.sum(rows * rows, axis=-1))


@jax.jit
def _nearest(features, half_squares, queries):
    """The nearest entries for ``[n, v, 18]`` queries and their squared distances."""

    def nearest(query):
        product = jnp.dot(query, features.T, precision=jax.lax.Precision.HIGHEST)
        return jax.lax.top_k(product - half_squares, _PER_VARIANT)

    score, index = jax.lax.map(nearest, queries, batch_size=_QUERY_TILE)
    return index, jnp.sum(queries * queries, axis=-1, keepdims=True) - 2.0 * score


def _tip_frame(tips):
    """A frame on three tips: from the thumb to between the wraps, and along the wraps."""
    middle = 0.5 * (tips[..., 1, :] + tips[..., 2, :])
    x = unit(middle - tips[..., 0, :])
    along = tips[..., 1, :] - tips[..., 2, :]
    y = unit(along - dot(along, x)[..., None] * x)
    origin = 0.5 * (tips[..., 0, :] + middle)
    return origin, jnp.stack([x, y, jnp.cross(x, y)], axis=-1)


def make_ranking(arrays: RobotArrays, clearance: float) -> Callable[..., Float[Array, "n k"]]:
    """Compiles the estimate of how much a hand posture collides around the targets.

    ``rank(q[n, k, joints], goals[n, k, 3, 3], p_wo[n, 3], R_wo[n, 3, 3], grid) -> [n, k]``: the
    hand is moved as a rigid body until its tips fit the goals best, and the squares of what its
    spheres lack in clearance from object and table are summed, [m²].

    Args:
        arrays: The robot.
        clearance: Wanted between hand and object or table, [m].
    """
    spheres = arrays.spheres

    def lacking(q, goals, p_wo, R_wo, grid):
        pos, mat = arrays.kinematics.forward(q)
        centre = arrays.sphere_centres(pos, mat)
        origin, frame = _tip_frame(pos[:3])
        goal_origin, goal_frame = _tip_frame(goals)
        moved = goal_origin + ((centre - origin) @ frame) @ goal_frame.T
        distance, _ = outside_clearance(grid, moved, p_wo, R_wo)
        return jnp.sum(jnp.maximum(spheres.radius + clearance - distance, 0.0) ** 2)

    @jax.jit
    def rank(q, goals, p_wo, R_wo, grid):
        over_starts = jax.vmap(lacking, in_axes=(0, 0, None, None, None))
        with jax.default_matmul_precision("highest"):
            return jax.lax.map(
                lambda problem: over_starts(*problem, grid),
                (q, goals, p_wo, R_wo),
                batch_size=_QUERY_TILE,
            )

    return rank


def choose_starts(
    library: StartLibrary,
    rank: Callable[..., Float[Array, "n k"]],
    goals: Float[np.ndarray, "n v 3 3"],
    inward: Float[np.ndarray, "n v 3 3"],
    usable: Bool[np.ndarray, "n v"],
    p_wo: Float[np.ndarray, "n 3"],
    R_wo: Float[np.ndarray, "n 3 3"],
    grid: DistanceGrid,
    count: int,
) -> tuple[Int[np.ndarray, "n count"], Int[np.ndarray, "n count"]]:
    """The most promising entries of the library for each problem, over all its variants.

    Those whose tips and pads are near the goals, and whose hand would not collide there.

    Args:
        library: Configurations.
        rank: From :func:`make_ranking`.
        goals: Standoff targets of the variants, world, [m].
        inward: Inward directions there.
        usable: Which variants may be used.
        p_wo: Object origins in world, [m].
        R_wo: Object rotations.
        grid: The object.
        count: Starts wanted per problem.

    Returns:
        Which variant and which entry, the best first.
    """
    queries = _features(jnp.float32(goals), jnp.float32(inward))
    index, distance = map(np.asarray, _nearest(library.features, library.half_squares, queries))
    per_variant = index.shape[-1]
    entry = index.reshape(len(goals), -1)
    options = np.repeat(np.asarray(goals, np.float32), per_variant, axis=1)
    lacking = rank(
        library.q[entry], options, np.asarray(p_wo, np.float32), np.asarray(R_wo, np.float32), grid
    )
    cost = distance.reshape(entry.shape) + _PENETRATION_WEIGHT**2 * np.asarray(lacking)
    cost = np.where(np.repeat(usable, per_variant, axis=1), cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")[:, :count]
    return order // per_variant, np.take_along_axis(entry, order, axis=1)
