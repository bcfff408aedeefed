"""Batched inverse kinematics of three fingertips: Levenberg–Marquardt from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.levenberg_marquardt import Linearised, minimise
from mjx_grasp.geometry.vectors import dot, norm
from mjx_grasp.handoff.clearance import outside_clearance
from mjx_grasp.handoff.config import IkConfig
from mjx_grasp.robot.arrays import RobotArrays
from mjx_grasp.robot.spheres import own_clearance, sphere_arms

_FINGERS = 3
_PALM = 2 * _FINGERS


class IkSolution(NamedTuple):
    """What the solver found for each problem.

    Attributes:
        q: ``[b, joints]`` configurations in [rad], within the limits.
        residual: ``[b, 3]`` distances of the tip frames from their targets in [m].
        pad_angle: ``[b, 3]`` angles between pad normals and inward directions in [rad].
        approach: ``[b, 3]`` the palm's approach direction, world.
        at_limit: ``[b]`` whether a solved joint is at its limit.
        cost: ``[b]`` the objective, [m²].
    """

    q: Float[np.ndarray, "b joints"]
    residual: Float[np.ndarray, "b 3"]
    pad_angle: Float[np.ndarray, "b 3"]
    approach: Float[np.ndarray, "b 3"]
    at_limit: Bool[np.ndarray, " b"]
    cost: Float[np.ndarray, " b"]


class _Known(NamedTuple):
    """What a configuration's errors tell beside; as in the solution."""

    residual: Float[Array, " 3"]
    pad_angle: Float[Array, " 3"]
    approach: Float[Array, " 3"]


def make_ik(arrays: RobotArrays, config: IkConfig) -> Callable[..., IkSolution]:
    """Compiles the solver of many problems around one object.

    ``solve(targets[b, 3, 3], inward[b, 3, 3], start[b, joints], p_wo[b, 3], R_wo[b, 3, 3], grid)``
    minimises, over the arm and the three grasping fingers and within the joint limits,

    ``Σ |x_tip − target|² + (w_o |n_pad − inward|)² + (w_p |q − q_nominal|)² + (w_c · missing)²``

    with a fixed number of Levenberg–Marquardt steps; *missing* is what a sphere of the hand lacks
    in clearance from object and table, and what it lacks from the other fingers. Targets are
    standoff positions of the tip frames' origins and unit inward directions, world frame; the grid
    is the object's, posed by ``p_wo, R_wo``. Where nothing can be evaluated, residuals and cost
    are infinite.

    Args:
        arrays: The robot.
        config: Weights and number of steps.
    """
    kin, spheres = arrays.kinematics, arrays.spheres
    columns = np.flatnonzero(arrays.solved)
    margin = np.minimum(config.limit_margin, 0.25 * (arrays.upper - arrays.lower))
    lower = np.asarray(arrays.lower + margin, np.float32)[columns]
    upper = np.asarray(arrays.upper - margin, np.float32)[columns]
    nominal = np.asarray(arrays.nominal, np.float32)
    pull = np.full(len(columns), config.posture_weight, np.float32)
    w_o, w_c = config.orientation_weight, config.clearance_weight
    carrier = spheres.frame + _PALM + 1
    reach = np.tile(np.asarray(spheres.radius + config.clearance, np.float32), 2)

    def full(x):
        return jnp.asarray(nominal).at[columns].set(x)

    def solve_one(targets, inward, start, p_wo, R_wo, grid):
        def linearise(x) -> Linearised:
            pos, mat = kin.forward(full(x))
            jacobian = kin.jacobian(full(x))[:, :, columns]
            pads = mat[_FINGERS:_PALM, :, 0]
            arm = sphere_arms(spheres, mat[_PALM + 1 :])
            centre = pos[carrier] + arm
            distance, away = outside_clearance(grid, centre, p_wo, R_wo)
            own_distance, own_away = own_clearance(spheres, centre)
            missing = jnp.maximum(reach - jnp.concatenate([distance, own_distance]), 0.0)
            away = jnp.where(missing[:, None] > 0, jnp.concatenate([away, own_away]), 0.0)
            errors = pos[:_FINGERS] - targets, w_o * (pads - inward), w_c * missing
            # d(n_pad) = ω × n_pad, and a sphere's clearance changes by −away · (v + ω × arm).
            turning = jacobian[_FINGERS:_PALM, 3:]
            swing = w_o * jnp.cross(turning, pads[:, :, None], axisa=1, axisb=1, axisc=1)
            wrench = jnp.concatenate([away, jnp.cross(jnp.tile(arm, (2, 1)), away)], axis=-1)
            closing = -w_c * jnp.einsum("sk,skj->sj", wrench, jacobian[np.tile(carrier, 2)])
            rows = jacobian[:_FINGERS, :3].reshape(9, -1), swing.reshape(9, -1), closing
            known = _Known(
                residual=norm(pos[:_FINGERS] - targets),
                pad_angle=jnp.arccos(jnp.clip(dot(pads, inward), -1.0, 1.0)),
                approach=mat[_PALM] @ jnp.float32(arrays.approach_axis),
            )
            flat = jnp.concatenate([part.reshape(-1) for part in errors])
            return Linearised(flat, jnp.concatenate(rows), known)

        best = minimise(
            linearise, start[columns], lower, upper, pull, nominal[columns], config.iterations
        )
        return IkSolution(
            q=full(best.x), **best.known._asdict(), at_limit=best.at_bound, cost=best.cost
        )

    @jax.jit
    def solve(targets, inward, start, p_wo, R_wo, grid):
        with jax.default_matmul_precision("highest"):
            each = jax.vmap(solve_one, in_axes=(0, 0, 0, 0, 0, None))
            return each(targets, inward, start, p_wo, R_wo, grid)

    return solve
