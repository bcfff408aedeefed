"""A library of grasp-like configurations over the table, from which the IK starts are taken."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.vectors import dot, unit
from mjx_grasp.handoff.clearance import (
    DistanceGrid,
    outside_clearance,
    own_clearance,
    sphere_arms,
)
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.ik import RobotArrays

_BATCH = 16_384
# Of the frames: three tips, three pads and the palm come before the bodies with spheres.
_FIRST_BODY = 7
_FEW = 1024
_MAX_BATCHES = 400
# What counts as grasp-like: thumb pad against wrap pads, wraps side by side, tips apart as at the
# standoffs of the hand's span. Wide, for these are starts only.
_MAX_OPPOSING_COSINE = -0.3
_WRAP_GAP = (0.015, 0.075)
_TIP_SPAN = (0.06, 0.18)
_LOWEST_TIP, _HIGHEST_TIP, _LOWEST_PALM = 0.02, 0.40, 0.05
_MARGIN_XY = 0.12
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


def _grasp_like(tips, pads):
    gap = jnp.linalg.norm(tips[:, 1] - tips[:, 2], axis=-1)
    span = jnp.linalg.norm(tips[:, 0] - 0.5 * (tips[:, 1] + tips[:, 2]), axis=-1)
    opposing = jnp.sum(pads[:, :1] * pads[:, 1:], axis=-1).max(axis=-1)
    return (
        (opposing < _MAX_OPPOSING_COSINE)
        & (gap > _WRAP_GAP[0])
        & (gap < _WRAP_GAP[1])
        & (span > _TIP_SPAN[0])
        & (span < _TIP_SPAN[1])
    )


def build_library(
    arrays: RobotArrays, size: int, sampling: SamplingConfig, seed: int
) -> StartLibrary:
    """Draws configurations with the hand over the object area and the fingers about to grasp.

    First hand postures alone, whose pads face each other; then arm postures joined with them,
    kept where tips and palm are above the table in the object area.

    Args:
        arrays: The robot.
        size: Configurations wanted.
        sampling: The object area.
        seed: Of the draw.

    Raises:
        InputError: The robot does not reach the object area.
    """
    forward = jax.jit(jax.vmap(arrays.kinematics.forward))
    rng = np.random.default_rng([seed, 1])
    lower, upper = arrays.lower, arrays.upper
    hand = arrays.solved & ~arrays.arm

    @jax.jit
    @jax.vmap
    def fingers_apart(pos, mat):
        centre = pos[arrays.spheres.frame + _FIRST_BODY] + sphere_arms(
            arrays.spheres, mat[_FIRST_BODY:]
        )
        return jnp.all(own_clearance(arrays.spheres, centre)[0] >= arrays.spheres.radius)

    def opposed_and_apart(pos, mat):
        good = np.array(_grasp_like(pos[:, :3], mat[:, 3:6, :, 0]))
        # Few are left: the costlier question is asked of them alone, in one size.
        left = np.flatnonzero(good)[:_FEW]
        asked = np.resize(left, _FEW) if len(left) else np.zeros(_FEW, int)
        good[:] = False
        good[left] = np.asarray(fingers_apart(pos[asked], mat[asked]))[: len(left)]
        return good

    def draw(columns):
        q = np.tile(arrays.nominal, (_BATCH, 1))
        q[:, columns] = rng.uniform(lower[columns], upper[columns], (_BATCH, columns.sum()))
        return q

    def collected(wanted, sample, keep, what):
        kept, count = [], 0
        for _ in range(_MAX_BATCHES):
            q = sample()
            pos, mat = forward(np.asarray(q, np.float32))
            good = q[np.asarray(keep(pos, mat))]
            kept.append(good)
            count += len(good)
            if count >= wanted:
                return np.concatenate(kept)[:wanted]
        raise InputError("robot", f"{count} {what} in {_MAX_BATCHES * _BATCH} draws", "more")

    postures = collected(
        max(size // 10, 500),
        lambda: draw(hand),
        opposed_and_apart,
        "hand postures with thumb and wraps opposed",
    )

    def sample():
        q = draw(arrays.arm)
        q[:, hand] = postures[rng.integers(len(postures), size=_BATCH)][:, hand]
        return q

    def over_table(pos, mat):
        tips, palm = pos[:, :3], pos[:, 6]
        middle = tips.mean(axis=1)
        (x0, x1), (y0, y1) = sampling.x_range, sampling.y_range
        return (
            (middle[:, 0] > x0 - _MARGIN_XY)
            & (middle[:, 0] < x1 + _MARGIN_XY)
            & (middle[:, 1] > y0 - _MARGIN_XY)
            & (middle[:, 1] < y1 + _MARGIN_XY)
            & (tips[:, :, 2].min(axis=1) > _LOWEST_TIP)
            & (middle[:, 2] < _HIGHEST_TIP)
            & (palm[:, 2] > _LOWEST_PALM)
        )

    q = collected(size, sample, over_table, "arm postures over the object area")
    features = []
    for part in np.array_split(np.asarray(q, np.float32), -(-len(q) // _BATCH)):
        pos, mat = forward(_filled(part))
        features.append(np.asarray(_features(pos[:, :3], mat[:, 3:6, :, 0]))[: len(part)])
    rows = np.concatenate(features)
    return StartLibrary(np.asarray(q, np.float32), rows, 0.5 * np.sum(rows * rows, axis=-1))


def _filled(part: np.ndarray) -> np.ndarray:
    """Padded to the batch that is compiled already."""
    return np.concatenate([part, np.repeat(part[:1], _BATCH - len(part), axis=0)])


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
        centre = pos[spheres.frame + _FIRST_BODY] + sphere_arms(spheres, mat[_FIRST_BODY:])
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
