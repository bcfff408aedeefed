"""Random grasp-like configurations over the table, where searches for a grasp start."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.surroundings import placed
from mjx_grasp.sim.scene import ObjectArea

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


def draw_postures(
    body: Body, count: int, area: ObjectArea, seed: int
) -> Float[np.ndarray, "count joints"]:
    """Draws configurations with the hand over the object area and the fingers about to grasp.

    First hand postures alone, whose pads face each other; then arm postures joined with them,
    kept where tips and palm are above the table in the object area.

    Args:
        body: The robot.
        count: Configurations wanted.
        area: Where objects lie.
        seed: Of the draw.

    Returns:
        Joint positions in [rad].

    Raises:
        InputError: The robot does not reach the object area.
    """
    forward = jax.jit(jax.vmap(body.kinematics.forward))
    palm_of = jax.jit(jax.vmap(body.palm.forward))
    apart = jax.jit(jax.vmap(partial(_fingers_apart, body)))
    rng = np.random.default_rng([seed, 1])
    hand = body.grasping & ~body.arm
    # NumPy draws in double precision: from limits that are not rounded yet.
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    lower, upper = np.transpose([model.joint(name).range for name in body.robot.joints])

    def draw(columns: Bool[np.ndarray, " joints"]) -> Float[np.ndarray, "b joints"]:
        q = np.tile(body.home, (_BATCH, 1))
        q[:, columns] = rng.uniform(lower[columns], upper[columns], (_BATCH, columns.sum()))
        return q

    def opposed_and_apart() -> Float[np.ndarray, "n joints"]:
        q = draw(hand)
        pos, mat = forward(q)
        # Few are left: the costlier question is asked of them alone, in one size.
        left = np.flatnonzero(_grasp_like(pos[:, :FINGERS], mat[:, FINGERS:PALM, :, 0]))[:_FEW]
        asked = np.resize(left, _FEW) if len(left) else np.zeros(_FEW, int)
        return q[left[np.asarray(apart(q[asked]))[: len(left)]]]

    postures = _collected(
        max(count // 10, 500), opposed_and_apart, "hand postures with thumb and wraps opposed"
    )
    pos, mat = map(np.asarray, forward(postures))
    in_palm = np.einsum("nij,nfi->nfj", mat[:, PALM], pos[:, :FINGERS] - pos[:, PALM, None])
    low, high = np.transpose([area.x, area.y])

    def over_table() -> Float[np.ndarray, "n joints"]:
        q = draw(body.arm)
        chosen = rng.integers(len(postures), size=_BATCH)
        q[:, hand] = postures[chosen][:, hand]
        pos, mat = map(np.asarray, palm_of(q))
        tips = pos + np.einsum("nij,nfj->nfi", mat[:, 0], in_palm[chosen])
        middle = tips.mean(axis=1)
        return q[
            np.all((middle[:, :2] > low - _MARGIN_XY) & (middle[:, :2] < high + _MARGIN_XY), axis=1)
            & (tips[:, :, 2].min(axis=1) > _LOWEST_TIP)
            & (middle[:, 2] < _HIGHEST_TIP)
            & (pos[:, 0, 2] > _LOWEST_PALM)
        ]

    return _collected(count, over_table, "arm postures over the object area")


def _collected(
    wanted: int, sample: Callable[[], Float[np.ndarray, "n joints"]], what: str
) -> Float[np.ndarray, "wanted joints"]:
    """Samples until there are enough."""
    kept: list[np.ndarray] = []
    found = 0
    for _ in range(_MAX_BATCHES):
        kept.append(sample())
        found += len(kept[-1])
        if found >= wanted:
            return np.concatenate(kept)[:wanted]
    raise InputError("robot", f"{found} {what} in {_MAX_BATCHES * _BATCH} draws", "more")


def _grasp_like(tips: Float[Array, "n 3 3"], pads: Float[Array, "n 3 3"]) -> Bool[Array, " n"]:
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


def _fingers_apart(body: Body, q: Float[Array, " joints"]) -> Bool[Array, ""]:
    """Whether no two spheres of the hand overlap that must not."""
    at, _ = placed(body.hand_spheres, body.kinematics.motion(q))
    radius = body.hand_spheres.radius
    between = at[:, None, :] - at[None, :, :]
    gap = jnp.sqrt(jnp.sum(between * between, axis=-1)) - radius
    return jnp.all((gap >= radius[:, None]) | ~body.apart)
