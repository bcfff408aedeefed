"""Whether and how three tips can be where a candidate asks: batched Levenberg–Marquardt.

The same distances that bound the controller's commands enter as soft residuals, so that a solution
is one in which the controller can come to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import norm
from mjx_grasp.reaching.body import FINGERS, PALM, ReachBody
from mjx_grasp.reaching.command import (
    angular_jacobians,
    half_spaces,
    point_jacobians,
)
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.surroundings import Surroundings

_DAMPING_START, _DAMPING_FALL, _DAMPING_RISE = 1e-3, 0.3, 5.0
_DAMPING_FLOOR, _DAMPING_RANGE = 1e-3, (1e-7, 1e2)


@dataclass(frozen=True)
class IkConfig:
    """Settings of the solver."""

    iterations: int = 30
    """Levenberg–Marquardt steps, fixed [-]"""
    orientation_weight: float = 0.012
    """pad normals against tips [m/rad]"""
    posture_weight: float = 0.001
    """pull of arm and grasping fingers towards the reference posture [m/rad]"""
    idle_weight: float = 0.01
    """the same of the other fingers [m/rad]"""
    clearance_weight: float = 2.0
    """missing clearance against tip errors [m/m]"""


class IkSolution(NamedTuple):
    """What the solver found.

    Attributes:
        q: ``[joints]`` within the limits less their margin, [rad].
        error: ``[3]`` tip frames to their goals, [m].
        missing: Largest lack of a clearance that the controller keeps, [m]; 0 if it lacks none.
        penetration: Deepest overlap of robot and object, table or itself, [m]; 0 if there is none.
        at_limit: Whether a joint is at its limit.
    """

    q: Float[Array, " joints"]
    error: Float[Array, " 3"]
    missing: Float[Array, ""]
    penetration: Float[Array, ""]
    at_limit: Array


def solve_ik(
    body: ReachBody,
    config: ReachConfig,
    ik: IkConfig,
    goals: Float[Array, "3 3"],
    pads: Float[Array, "3 3"],
    around: Surroundings,
    start: Float[Array, " joints"],
    reference: Float[Array, " joints"],
) -> IkSolution:
    """Minimises ``Σ|x_tip − goal|² + (w_o|n_pad − n*|)² + (w_c·missing)² + Σ(w_p(q − q_ref))²``.

    Joints pushed against a limit leave the step, so that the others make up for them.

    Args:
        body: The robot.
        config: Clearances and margins of the controller.
        ik: Weights and steps.
        goals: Of the tip frames, world, [m].
        pads: Unit directions for the pad normals.
        around: Object and obstacles.
        start: Where the search begins, [rad].
        reference: Posture to stay near, [rad].
    """
    margin = np.minimum(config.limits.limit_margin, 0.25 * (body.upper - body.lower))
    lower, upper = jnp.asarray(body.lower + margin), jnp.asarray(body.upper - margin)
    horizon = config.limits.horizon
    busy = body.arm | body.grasping
    w_posture = jnp.where(jnp.asarray(busy), ik.posture_weight, ik.idle_weight)

    def errors(q):
        motion = body.kinematics.motion(q)
        slope, bound, near = half_spaces(body, motion, around, _unbounded(config))
        missing = jnp.maximum(bound * horizon, 0.0)
        tips, normals = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
        parts = (
            (tips - goals).reshape(-1),
            ik.orientation_weight * (normals - pads).reshape(-1),
            ik.clearance_weight * missing,
            w_posture * (q - reference),
        )
        return jnp.concatenate(parts), (motion, slope, missing, near)

    def jacobian(found):
        motion, slope, missing, _ = found
        tips, normals = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
        linear = point_jacobians(body, motion, np.arange(FINGERS), tips)
        turning = angular_jacobians(body, motion, np.arange(FINGERS, PALM))
        swing = jnp.cross(turning, normals[:, :, None], axisa=1, axisb=1, axisc=1)
        return jnp.concatenate(
            [
                linear.reshape(3 * FINGERS, -1),
                ik.orientation_weight * swing.reshape(3 * FINGERS, -1),
                jnp.where(missing[:, None] > 0, -ik.clearance_weight * slope, 0.0),
            ]
        )

    def step(_, state):
        q, cost, damping = state
        residual, found = errors(q)
        rows = jacobian(found)
        top = len(rows)
        gradient = rows.T @ residual[:top] + w_posture * residual[top:]
        stuck = ((q <= lower) & (gradient > 0)) | ((q >= upper) & (gradient < 0))
        free = jnp.where(stuck, 0.0, 1.0)
        rows = rows * free
        hessian = rows.T @ rows + jnp.diag(w_posture**2)
        hessian = hessian + damping * jnp.diag(jnp.diag(hessian) + _DAMPING_FLOOR)
        trial = jnp.clip(q - cho_solve(cho_factor(hessian), gradient * free), lower, upper)
        trial_cost = jnp.sum(errors(trial)[0] ** 2)
        better = trial_cost < cost
        factor = jnp.where(better, _DAMPING_FALL, _DAMPING_RISE)
        return (
            jnp.where(better, trial, q),
            jnp.where(better, trial_cost, cost),
            jnp.clip(damping * factor, *_DAMPING_RANGE),
        )

    q = jnp.clip(start, lower, upper)
    state = (q, jnp.sum(errors(q)[0] ** 2), jnp.float32(_DAMPING_START))
    q, _, _ = jax.lax.fori_loop(0, ik.iterations, step, state)
    _, (motion, _, missing, near) = errors(q)
    distances = jnp.concatenate([part.distance for part in near.values()])
    return IkSolution(
        q=q,
        error=norm(motion.pos[:FINGERS] - goals),
        missing=jnp.max(missing),
        penetration=jnp.maximum(-jnp.min(distances), 0.0),
        at_limit=jnp.any((q <= lower) | (q >= upper)),
    )


def _unbounded(config: ReachConfig) -> ReachConfig:
    """The same clearances, missing ones in full."""
    return replace(config, limits=replace(config.limits, escape_speed=np.inf))
