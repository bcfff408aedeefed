"""Whether and how three tips can be where they are wanted: Levenberg–Marquardt, for many at once.

Clearances that are missing enter as soft residuals, so that a solution is one in which the robot
can come to rest.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.levenberg_marquardt import Linearised, minimise
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.clearances import proximities
from mjx_grasp.posture.config import ClearanceConfig, IkConfig
from mjx_grasp.posture.surroundings import Surroundings, stacked


class TipGoals(NamedTuple):
    """Where the fingertips are to be; world frame."""

    tips: Float[Array, "*v 3 3"]
    """of the tip frames' origins [m]"""
    pads: Float[Array, "*v 3 3"]
    """unit directions for the pad normals"""


class IkSolution(NamedTuple):
    """What the solver found."""

    q: Float[Array, " joints"]
    """within the limits less their margin [rad]"""
    error: Float[Array, " 3"]
    """tip frames to their goals [m]"""
    missing: Float[Array, ""]
    """largest lack of a clearance, 0 if none is missing [m]"""
    penetration: Float[Array, ""]
    """deepest overlap of robot and object, table or itself, 0 if there is none [m]"""
    at_limit: Bool[Array, ""]
    """whether a joint that was solved for is at its limit"""
    cost: Float[Array, ""]
    """the objective [m²]"""


class _Known(NamedTuple):
    """What a configuration's errors tell beside."""

    error: Float[Array, " 3"]
    missing: Float[Array, ""]
    distance: Float[Array, ""]
    """the least of all"""


def solve_ik(
    body: Body,
    config: IkConfig,
    clearances: ClearanceConfig,
    goals: TipGoals,
    around: Surroundings,
    start: Float[Array, " joints"],
    reference: Float[Array, " joints"],
    steps: Int[Array, ""] | None = None,
) -> IkSolution:
    """Minimises ``Σ|x_tip − goal|² + (w_o|n_pad − n*|)² + (w_c·missing)² + Σ(w_p(q − q_ref))²``.

    Within the joint limits less their margin. What cannot be evaluated is no solution: its error,
    and all that it lacks, is infinite.

    Args:
        body: The robot.
        config: Weights and steps.
        clearances: What is missing if it is nearer.
        goals: Of the tips.
        around: Object and obstacles.
        start: Where the search begins, [rad].
        reference: Posture to stay near, [rad].
        steps: Of the solver; the configuration's by default.
    """
    busy, idle_weight = body.arm | body.grasping, config.idle_weight
    solved = np.flatnonzero(busy | (idle_weight is not None))
    pull = np.where(busy, config.posture_weight, idle_weight or 0.0)[solved]
    lower, upper = (jnp.asarray(bound[solved]) for bound in body.within(clearances.joint_limits))

    def whole(x: Float[Array, " solved"]) -> Float[Array, " joints"]:
        return reference.at[solved].set(x)

    def linearise(x: Float[Array, " solved"]) -> Linearised:
        found = linearised(body, config, clearances, goals, around, whole(x))
        return found._replace(rows=found.rows[:, solved])

    best = minimise(
        linearise,
        start[solved],
        lower,
        upper,
        jnp.asarray(pull, jnp.float32),
        reference[solved],
        config.iterations if steps is None else steps,
        config.damping,
    )
    return IkSolution(
        q=whole(best.x),
        error=best.known.error,
        missing=best.known.missing,
        penetration=jnp.maximum(-best.known.distance, 0.0),
        at_limit=best.at_bound,
        cost=best.cost,
    )


def linearised(
    body: Body,
    config: IkConfig,
    clearances: ClearanceConfig,
    goals: TipGoals,
    around: Surroundings,
    q: Float[Array, " joints"],
) -> Linearised:
    """The weighted errors of a configuration and their Jacobian, without the pull [m, m/rad]."""
    motion = body.kinematics.motion(q)
    near, safe = proximities(body, motion, around, clearances)
    everything = stacked(list(near.values()))
    missing = jnp.maximum(safe - everything.distance, 0.0)
    tips, normals = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
    turning = body.angular_jacobians(motion, np.arange(FINGERS, PALM))
    swing = jnp.cross(turning, normals[:, :, None], axisa=1, axisb=1, axisc=1)
    errors = (
        (tips - goals.tips).reshape(-1),
        config.orientation_weight * (normals - goals.pads).reshape(-1),
        config.clearance_weight * missing,
    )
    rows = (
        body.point_jacobians(motion, np.arange(FINGERS), tips).reshape(3 * FINGERS, -1),
        config.orientation_weight * swing.reshape(3 * FINGERS, -1),
        jnp.where(missing[:, None] > 0, -config.clearance_weight * everything.slope, 0.0),
    )
    known = _Known(norm(tips - goals.tips), jnp.max(missing), jnp.min(everything.distance))
    return Linearised(jnp.concatenate(errors), jnp.concatenate(rows), known)
