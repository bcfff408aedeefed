"""Whether and how three tips can be where a candidate asks: batched Levenberg–Marquardt.

The same distances that bound the controller's commands enter as soft residuals, so that a solution
is one in which the controller can come to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.levenberg_marquardt import Linearised, minimise
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import FINGERS, PALM, ReachBody
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import (
    angular_jacobians,
    half_spaces,
    point_jacobians,
)
from mjx_grasp.reaching.config import ReachConfig


@dataclass(frozen=True)
class PlanIkConfig:
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


class PlanIkSolution(NamedTuple):
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


class _Known(NamedTuple):
    """What a configuration's errors tell beside."""

    error: Float[Array, " 3"]
    missing: Float[Array, ""]
    distance: Float[Array, ""]  # the least of all


def solve_ik(
    body: ReachBody,
    config: ReachConfig,
    ik: PlanIkConfig,
    goals: Float[Array, "3 3"],
    pads: Float[Array, "3 3"],
    around: Surroundings,
    start: Float[Array, " joints"],
    reference: Float[Array, " joints"],
) -> PlanIkSolution:
    """Minimises ``Σ|x_tip − goal|² + (w_o|n_pad − n*|)² + (w_c·missing)² + Σ(w_p(q − q_ref))²``.

    Within the joint limits less their margin. What cannot be evaluated is no solution: its error,
    and all that it lacks, is infinite.

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

    def linearise(q) -> Linearised:
        motion = body.kinematics.motion(q)
        slope, bound, near = half_spaces(body, motion, around, _unbounded(config))
        missing = jnp.maximum(bound * horizon, 0.0)
        tips, normals = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
        turning = angular_jacobians(body, motion, np.arange(FINGERS, PALM))
        swing = jnp.cross(turning, normals[:, :, None], axisa=1, axisb=1, axisc=1)
        errors = (
            (tips - goals).reshape(-1),
            ik.orientation_weight * (normals - pads).reshape(-1),
            ik.clearance_weight * missing,
        )
        rows = (
            point_jacobians(body, motion, np.arange(FINGERS), tips).reshape(3 * FINGERS, -1),
            ik.orientation_weight * swing.reshape(3 * FINGERS, -1),
            jnp.where(missing[:, None] > 0, -ik.clearance_weight * slope, 0.0),
        )
        known = _Known(
            error=norm(tips - goals),
            missing=jnp.max(missing),
            distance=jnp.min(jnp.concatenate([part.distance for part in near.values()])),
        )
        return Linearised(jnp.concatenate(errors), jnp.concatenate(rows), known)

    best = minimise(linearise, start, lower, upper, w_posture, reference, ik.iterations)
    return PlanIkSolution(
        q=best.x,
        error=best.known.error,
        missing=best.known.missing,
        penetration=jnp.maximum(-best.known.distance, 0.0),
        at_limit=best.at_bound,
    )


def _unbounded(config: ReachConfig) -> ReachConfig:
    """The same clearances, missing ones in full."""
    return replace(config, limits=replace(config.limits, escape_speed=np.inf))
