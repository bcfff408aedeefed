"""Random grasp-like configurations over the table, where searches for a grasp start."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError
from mjx_grasp.robot.arrays import RobotArrays
from mjx_grasp.robot.spheres import own_clearance

_BATCH = 16_384
_FEW = 1024
_MAX_BATCHES = 400
# What counts as grasp-like: thumb pad against wrap pads, wraps side by side, tips apart as at the
# standoffs of the hand's span. Wide, for these are starts only.
_MAX_OPPOSING_COSINE = -0.3
_WRAP_GAP = (0.015, 0.075)
_TIP_SPAN = (0.06, 0.18)
_LOWEST_TIP, _HIGHEST_TIP, _LOWEST_PALM = 0.02, 0.40, 0.05
_MARGIN_XY = 0.12


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


def draw_postures(
    arrays: RobotArrays,
    count: int,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    seed: int,
) -> Float[np.ndarray, "count joints"]:
    """Draws configurations with the hand over the object area and the fingers about to grasp.

    First hand postures alone, whose pads face each other; then arm postures joined with them,
    kept where tips and palm are above the table in the object area.

    Args:
        arrays: The robot.
        count: Configurations wanted.
        x_range: Object area in front of the arm, [m].
        y_range: Object area, lateral, [m].
        seed: Of the draw.

    Returns:
        Joint positions in [rad].

    Raises:
        InputError: The robot does not reach the object area.
    """
    forward = jax.jit(jax.vmap(arrays.kinematics.forward))
    palm_of = jax.jit(jax.vmap(arrays.palm.forward))
    rng = np.random.default_rng([seed, 1])
    lower, upper = arrays.lower, arrays.upper
    hand = arrays.solved & ~arrays.arm

    @jax.jit
    @jax.vmap
    def fingers_apart(pos, mat):
        centre = arrays.sphere_centres(pos, mat)
        return jnp.all(own_clearance(arrays.spheres, centre)[0] >= arrays.spheres.radius)

    def draw(columns):
        q = np.tile(arrays.nominal, (_BATCH, 1))
        q[:, columns] = rng.uniform(lower[columns], upper[columns], (_BATCH, columns.sum()))
        return q

    def collected(wanted, sample, what):
        kept, found = [], 0
        for _ in range(_MAX_BATCHES):
            kept.append(sample())
            found += len(kept[-1])
            if found >= wanted:
                return np.concatenate(kept)[:wanted]
        raise InputError("robot", f"{found} {what} in {_MAX_BATCHES * _BATCH} draws", "more")

    def opposed_and_apart():
        q = draw(hand)
        pos, mat = forward(np.asarray(q, np.float32))
        # Few are left: the costlier question is asked of them alone, in one size.
        left = np.flatnonzero(_grasp_like(pos[:, :3], mat[:, 3:6, :, 0]))[:_FEW]
        asked = np.resize(left, _FEW) if len(left) else np.zeros(_FEW, int)
        return q[left[np.asarray(fingers_apart(pos[asked], mat[asked]))[: len(left)]]]

    postures = collected(
        max(count // 10, 500), opposed_and_apart, "hand postures with thumb and wraps opposed"
    )
    pos, mat = map(np.asarray, forward(np.asarray(postures, np.float32)))
    in_palm = np.einsum("nij,nfi->nfj", mat[:, 6], pos[:, :3] - pos[:, 6:7])

    def over_table():
        q = draw(arrays.arm)
        chosen = rng.integers(len(postures), size=_BATCH)
        q[:, hand] = postures[chosen][:, hand]
        pos, mat = map(np.asarray, palm_of(np.asarray(q, np.float32)))
        tips = pos + np.einsum("nij,nfj->nfi", mat[:, 0], in_palm[chosen])
        middle = tips.mean(axis=1)
        low, high = np.transpose([x_range, y_range])
        return q[
            np.all((middle[:, :2] > low - _MARGIN_XY) & (middle[:, :2] < high + _MARGIN_XY), axis=1)
            & (tips[:, :, 2].min(axis=1) > _LOWEST_TIP)
            & (middle[:, 2] < _HIGHEST_TIP)
            & (pos[:, 0, 2] > _LOWEST_PALM)
        ]

    q = collected(count, over_table, "arm postures over the object area")
    return np.asarray(q, np.float32)
