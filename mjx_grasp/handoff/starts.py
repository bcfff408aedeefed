"""A library of grasp-like configurations over the table, from which the IK starts are taken."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.ik import RobotArrays

_BATCH = 16_384
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
_PER_VARIANT = 4


class StartLibrary(NamedTuple):
    """Configurations and where they put tips and pads.

    Attributes:
        q: ``[l, joints]`` in [rad].
        features: ``[l, 18]`` tip positions in [m], pad directions scaled to [m]; world.
    """

    q: Float[np.ndarray, "l joints"]
    features: Float[np.ndarray, "l 18"]


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

    def draw(columns):
        q = np.tile(arrays.nominal, (_BATCH, 1))
        q[:, columns] = rng.uniform(lower[columns], upper[columns], (_BATCH, columns.sum()))
        return q

    def collected(wanted, sample, keep, what):
        kept, count = [], 0
        for _ in range(_MAX_BATCHES):
            q = sample()
            pos, mat = forward(np.float32(q))
            good = q[np.asarray(keep(pos[:, :3], mat[:, 3:6, :, 0], pos[:, 6]))]
            kept.append(good)
            count += len(good)
            if count >= wanted:
                return np.concatenate(kept)[:wanted]
        raise InputError("robot", f"{count} {what} in {_MAX_BATCHES * _BATCH} draws", "more")

    postures = collected(
        max(size // 10, 500),
        lambda: draw(hand),
        lambda tips, pads, palm: _grasp_like(tips, pads),
        "hand postures with thumb and wraps opposed",
    )

    def sample():
        q = draw(arrays.arm)
        q[:, hand] = postures[rng.integers(len(postures), size=_BATCH)][:, hand]
        return q

    def over_table(tips, pads, palm):
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
    for part in np.array_split(np.float32(q), -(-len(q) // _BATCH)):
        pos, mat = forward(_filled(part))
        features.append(np.asarray(_features(pos[:, :3], mat[:, 3:6, :, 0]))[: len(part)])
    return StartLibrary(np.float32(q), np.concatenate(features))


def _filled(part: np.ndarray) -> np.ndarray:
    """Padded to the batch that is compiled already."""
    return np.concatenate([part, np.repeat(part[:1], _BATCH - len(part), axis=0)])


@jax.jit
def _nearest(features, queries):
    """The nearest entries for ``[n, v, 18]`` queries and their squared distances."""
    norms = 0.5 * jnp.sum(features * features, axis=-1)

    def nearest(query):
        product = jnp.dot(query, features.T, precision=jax.lax.Precision.HIGHEST)
        return jax.lax.top_k(product - norms, _PER_VARIANT)

    score, index = jax.lax.map(nearest, queries, batch_size=_QUERY_TILE)
    return index, jnp.sum(queries * queries, axis=-1, keepdims=True) - 2.0 * score


def nearest_starts(
    library: StartLibrary,
    tips: Float[np.ndarray, "n v 3 3"],
    inward: Float[np.ndarray, "n v 3 3"],
    usable: Bool[np.ndarray, "n v"],
    count: int,
) -> tuple[Int[np.ndarray, "n count"], Int[np.ndarray, "n count"]]:
    """The library's entries nearest to the targets, over all variants of a problem.

    Args:
        library: Configurations.
        tips: Standoff targets of the variants, world, [m].
        inward: Inward directions there.
        usable: Which variants may be used.
        count: Starts wanted per problem.

    Returns:
        Which variant and which entry, nearest first.
    """
    queries = np.asarray(_features(jnp.float32(tips), jnp.float32(inward)))
    index, distance = map(np.asarray, _nearest(library.features, queries))
    distance = np.where(usable[:, :, None], distance, np.inf)
    order = np.argsort(distance.reshape(len(tips), -1), axis=1, kind="stable")[:, :count]
    variant = order // index.shape[-1]
    return variant, np.take_along_axis(index.reshape(len(tips), -1), order, axis=1)
