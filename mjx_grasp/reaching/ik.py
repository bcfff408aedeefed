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


class _Evaluation(NamedTuple):
    """A configuration and what its errors are."""

    q: Float[Array, " joints"]
    cost: Float[Array, ""]
    gradient: Float[Array, " joints"]
    rows: Float[Array, "n joints"]  # the Jacobian, without the posture's diagonal
    error: Float[Array, " 3"]
    missing: Float[Array, ""]
    distance: Float[Array, ""]  # the least of all


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

    def evaluated(q) -> _Evaluation:
        motion = body.kinematics.motion(q)
        slope, bound, near = half_spaces(body, motion, around, _unbounded(config))
        missing = jnp.maximum(bound * horizon, 0.0)
        tips, normals = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
        turning = angular_jacobians(body, motion, np.arange(FINGERS, PALM))
        swing = jnp.cross(turning, normals[:, :, None], axisa=1, axisb=1, axisc=1)
        residual = (
            (tips - goals).reshape(-1),
            ik.orientation_weight * (normals - pads).reshape(-1),
            ik.clearance_weight * missing,
        )
        rows = (
            point_jacobians(body, motion, np.arange(FINGERS), tips).reshape(3 * FINGERS, -1),
            ik.orientation_weight * swing.reshape(3 * FINGERS, -1),
            jnp.where(missing[:, None] > 0, -ik.clearance_weight * slope, 0.0),
        )
        posture, errors = w_posture * (q - reference), jnp.concatenate(residual)
        return _Evaluation(
            q=q,
            cost=jnp.sum(errors**2) + jnp.sum(posture**2),
            gradient=jnp.concatenate(rows).T @ errors + w_posture * posture,
            rows=jnp.concatenate(rows),
            error=norm(tips - goals),
            missing=jnp.max(missing),
            distance=jnp.min(jnp.concatenate([part.distance for part in near.values()])),
        )

    def next_trial(at: _Evaluation, damping):
        stuck = (at.q <= lower) & (at.gradient > 0) | (at.q >= upper) & (at.gradient < 0)
        free = jnp.where(stuck, 0.0, 1.0)
        rows = at.rows * free
        hessian = rows.T @ rows + jnp.diag(w_posture**2)
        hessian = hessian + damping * jnp.diag(jnp.diag(hessian) + _DAMPING_FLOOR)
        return jnp.clip(at.q - cho_solve(cho_factor(hessian), at.gradient * free), lower, upper)

    def step(_, state):
        best, damping, trial = state
        new = evaluated(trial)
        better = new.cost < best.cost
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)
        factor = jnp.where(better, _DAMPING_FALL, _DAMPING_RISE)
        damping = jnp.clip(damping * factor, *_DAMPING_RANGE)
        return best, damping, next_trial(best, damping)

    # The start is the first trial: distances, which are most of the work and of what has to be
    # compiled, are evaluated in one place and once a step.
    start = jnp.clip(start, lower, upper)
    unsolved = jax.tree.map(
        lambda a: jnp.full(a.shape, jnp.inf, a.dtype), jax.eval_shape(evaluated, start)
    )
    state = unsolved._replace(q=start), jnp.float32(_DAMPING_START / _DAMPING_FALL), start
    best, _, _ = jax.lax.fori_loop(0, ik.iterations + 1, step, state)
    return IkSolution(
        q=best.q,
        error=best.error,
        missing=best.missing,
        penetration=jnp.maximum(-best.distance, 0.0),
        at_limit=jnp.any((best.q <= lower) | (best.q >= upper)),
    )


def _unbounded(config: ReachConfig) -> ReachConfig:
    """The same clearances, missing ones in full."""
    return replace(config, limits=replace(config.limits, escape_speed=np.inf))
