"""Batched inverse kinematics of three fingertips: Levenberg–Marquardt from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Bool, Float

from mjx_grasp.geometry.vectors import dot, norm
from mjx_grasp.handoff.clearance import outside_clearance
from mjx_grasp.handoff.config import IkConfig
from mjx_grasp.robot.arrays import RobotArrays
from mjx_grasp.robot.spheres import own_clearance, sphere_arms

_FINGERS = 3
_PALM = 2 * _FINGERS
_DAMPING_START, _DAMPING_FALL, _DAMPING_RISE = 1e-3, 0.3, 5.0
# Added to the diagonal that the damping scales, so that a joint without a lever does not run off.
_DAMPING_FLOOR = 1e-3
_DAMPING_RANGE = (1e-7, 1e2)


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


def make_ik(arrays: RobotArrays, config: IkConfig) -> Callable[..., IkSolution]:
    """Compiles the solver of many problems around one object.

    ``solve(targets[b, 3, 3], inward[b, 3, 3], start[b, joints], p_wo[b, 3], R_wo[b, 3, 3], grid)``
    minimises, over the arm and the three grasping fingers and within the joint limits,

    ``Σ |x_tip − target|² + (w_o |n_pad − inward|)² + (w_p |q − q_nominal|)² + (w_c · missing)²``

    with a fixed number of Levenberg–Marquardt steps; *missing* is what a sphere of the hand lacks
    in clearance from object and table, and what it lacks from the other fingers. Joints pushed
    against a limit leave the step, so that the others make up for them. Targets are standoff
    positions of the tip frames' origins and unit inward directions, world frame; the grid is the
    object's, posed by ``p_wo, R_wo``.

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
    w_o, w_p, w_c = config.orientation_weight, config.posture_weight, config.clearance_weight
    carrier = spheres.frame + _PALM + 1
    reach = np.tile(np.asarray(spheres.radius + config.clearance, np.float32), 2)

    def full(x):
        return jnp.asarray(nominal).at[columns].set(x)

    def errors(x, problem):
        """Weighted residuals of tips, pads and clearance, and what their Jacobian needs."""
        targets, inward, p_wo, R_wo, grid = problem
        pos, mat = kin.forward(full(x))
        pads = mat[_FINGERS:_PALM, :, 0]
        arm = sphere_arms(spheres, mat[_PALM + 1 :])
        centre = pos[carrier] + arm
        distance, away = outside_clearance(grid, centre, p_wo, R_wo)
        own_distance, own_away = own_clearance(spheres, centre)
        missing = jnp.maximum(reach - jnp.concatenate([distance, own_distance]), 0.0)
        away = jnp.where(missing[:, None] > 0, jnp.concatenate([away, own_away]), 0.0)
        parts = pos[:_FINGERS] - targets, w_o * (pads - inward), w_c * missing
        return jnp.concatenate([part.reshape(-1) for part in parts]), pads, arm, away

    def objective(x, problem):
        posture = w_p * (x - nominal[columns])
        return jnp.sum(errors(x, problem)[0] ** 2) + jnp.sum(posture**2)

    def step(_, state, problem):
        x, cost, damping = state
        residual, pads, arm, away = errors(x, problem)
        jacobian = kin.jacobian(full(x))[:, :, columns]
        # d(n_pad) = ω × n_pad, and a sphere's clearance changes by −away · (v + ω × arm).
        turning = jacobian[_FINGERS:_PALM, 3:]
        swing = w_o * jnp.cross(turning, pads[:, :, None], axisa=1, axisb=1, axisc=1)
        wrench = jnp.concatenate([away, jnp.cross(jnp.tile(arm, (2, 1)), away)], axis=-1)
        closing = -w_c * jnp.einsum("sk,skj->sj", wrench, jacobian[np.tile(carrier, 2)])
        rows = [jacobian[:_FINGERS, :3].reshape(9, -1), swing.reshape(9, -1), closing]
        rows = jnp.concatenate(rows, axis=0)
        gradient = rows.T @ residual + w_p**2 * (x - nominal[columns])
        stuck = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = jnp.where(stuck, 0.0, 1.0)
        rows = rows * free
        hessian = rows.T @ rows + w_p**2 * jnp.eye(len(columns))
        hessian = hessian + damping * jnp.diag(jnp.diag(hessian) + _DAMPING_FLOOR)
        move = cho_solve(cho_factor(hessian), gradient * free)
        trial = jnp.clip(x - move, lower, upper)
        trial_cost = objective(trial, problem)
        better = trial_cost < cost
        damping = damping * jnp.where(better, _DAMPING_FALL, _DAMPING_RISE)
        return (
            jnp.where(better, trial, x),
            jnp.where(better, trial_cost, cost),
            jnp.clip(damping, *_DAMPING_RANGE),
        )

    def solve_one(targets, inward, start, p_wo, R_wo, grid):
        problem = targets, inward, p_wo, R_wo, grid
        x = jnp.clip(start[columns], lower, upper)
        state = (x, objective(x, problem), jnp.float32(_DAMPING_START))
        body = partial(step, problem=problem)
        x, cost, _ = jax.lax.fori_loop(0, config.iterations, body, state)
        q = full(x)
        pos, mat = kin.forward(q)
        cosine = dot(mat[_FINGERS:_PALM, :, 0], inward)
        return IkSolution(
            q=q,
            residual=norm(pos[:_FINGERS] - targets),
            pad_angle=jnp.arccos(jnp.clip(cosine, -1.0, 1.0)),
            approach=mat[_PALM] @ jnp.float32(arrays.approach_axis),
            at_limit=jnp.any((x <= lower) | (x >= upper)),
            cost=cost,
        )

    @jax.jit
    def solve(targets, inward, start, p_wo, R_wo, grid):
        with jax.default_matmul_precision("highest"):
            each = jax.vmap(solve_one, in_axes=(0, 0, 0, 0, 0, None))
            return each(targets, inward, start, p_wo, R_wo, grid)

    return solve
