"""From a planned configuration to the hand's motion: along a funnel that moves with the object.

The hand first goes to a pose retreated from the planned one, out of the object's reach, and comes
in along a straight line once it is aligned. All of it is relative to the object, so that it follows
when the object moves, and retreats when a jump of the object has spoilt the alignment.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.linear import solve_spd
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import PALM, Body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.config import GuideConfig
from mjx_grasp.robot.kinematics import Motion

# A palm this near to where it should be needs no step, [m] and [rad] together.
_SAME = 2e-5


class Guide(NamedTuple):
    """A planned grasp and the way to it, in the object frame; of two the second is retreated."""

    known: Bool[Array, ""]
    """whether there is one"""
    q: Float[Array, "2 joints"]
    """configurations [rad]"""
    palm_pos: Float[Array, "2 3"]
    """the palm frame at them [m]"""
    palm_mat: Float[Array, "2 3 3"]
    """its rotation"""
    tip_shift: Float[Array, " 3"]
    """from the planned standoff targets to the retreated ones [m]"""


class Tracked(NamedTuple):
    """A plan's configurations for the object's present pose."""

    q: Float[Array, "2 joints"]
    """planned and retreated [rad]"""
    astray: Float[Array, ""]
    """how far they are from it: 0 they fit, 1 not at all"""


class GuideGoal(NamedTuple):
    """Where the guide wants the hand at one tick; world frame."""

    known: Bool[Array, ""]
    """whether there is a guide"""
    q: Float[Array, " joints"]
    """configuration [rad]"""
    palm_pos: Float[Array, " 3"]
    """of the palm frame [m]"""
    palm_mat: Float[Array, "3 3"]
    """its rotation"""
    offset: Float[Array, " 3"]
    """the retreat that is left; standoff targets shift by it [m]"""
    left: Float[Array, ""]
    """share of the retreat that is left [-]"""
    astray: Float[Array, ""]
    """how little the configurations fit the object's pose: 0 they do, 1 not at all"""
    q_rate: Float[Array, " joints"]
    """how fast the configuration changes as the hand comes in [rad/s]"""
    palm_rate: Float[Array, " 3"]
    """how fast the palm's origin does [m/s]"""
    offset_rate: Float[Array, " 3"]
    """how fast the retreat does [m/s]"""


def no_guide(joints: int) -> Guide:
    """The guide of a reach that has none."""
    eye = jnp.broadcast_to(jnp.eye(3), (2, 3, 3))
    zeros, none = jnp.zeros((2, joints)), jnp.zeros(3)
    return Guide(jnp.asarray(False), zeros, jnp.zeros((2, 3)), eye, none)


def track(
    body: Body,
    guide: Guide,
    q: Float[Array, "2 joints"],
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    config: GuideConfig,
) -> Tracked:
    """One step of inverse kinematics that keeps the plan's configurations with a moving object.

    A damped least-squares step of the arm; nothing changes while the object is where it was.

    Args:
        body: The robot.
        guide: The plan.
        q: Its configurations as they were tracked so far, [rad].
        p_wo: Object origin in world, [m].
        R_wo: Object rotation.
        config: Damping, and what counts as astray.
    """
    lower, upper = body.within(config.limit_margin)

    def one(
        q: Float[Array, " joints"], pos: Float[Array, " 3"], mat: Float[Array, "3 3"]
    ) -> tuple[Float[Array, " joints"], Float[Array, ""]]:
        motion = body.kinematics.motion(q)
        turn = so3.log(R_wo @ mat @ motion.mat[PALM].T)
        way = p_wo + R_wo @ pos - motion.pos[PALM]
        error = jnp.concatenate([way, config.lever * turn])
        swept = jnp.cross(motion.screws[:, :3], motion.pos[PALM]) + motion.screws[:, 3:]
        rows = jnp.concatenate([swept, config.lever * motion.screws[:, :3]], axis=1)
        rows = jnp.where((body.arm & body.moves[PALM])[:, None], rows, 0.0)
        normal = rows.T @ rows + config.damping**2 * jnp.eye(6)
        step = rows @ solve_spd(normal, error)
        moved = jnp.where(norm(way) + norm(turn) > _SAME, q + step, q)
        return jnp.clip(moved, lower, upper), norm(way) + config.lever * norm(turn)

    q, residual = jax.vmap(one)(q, guide.palm_pos, guide.palm_mat)
    threshold, width = config.astray
    return Tracked(q, 0.5 * (1.0 + jnp.tanh((jnp.max(residual) - threshold) / width)))


def follow(
    guide: Guide,
    tracked: Tracked,
    left: Float[Array, ""],
    motion: Motion,
    around: Surroundings,
    config: GuideConfig,
    dt: float,
) -> tuple[GuideGoal, Float[Array, ""]]:
    """The goal of this tick and the share of the retreat that is left after it.

    Args:
        guide: The plan.
        tracked: Its configurations for the object's present pose.
        left: Share of the retreat that was left after the last tick, 1 at the start.
        motion: The robot.
        around: The object.
        config: Length of the funnel, alignment and speed.
        dt: Control period, [s].
    """
    p_wo, R_wo, q = around.p_wo, around.R_wo, tracked.q
    way = guide.palm_pos[1] - guide.palm_pos[0]
    between = so3.log(guide.palm_mat[1] @ guide.palm_mat[0].T)
    q_way = q[1] - q[0]
    shift = jnp.where(guide.known, R_wo @ guide.tip_shift, 0.0)

    def palm_at(share: Float[Array, ""]) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
        mat = so3.exp(share * between) @ guide.palm_mat[0]
        return p_wo + R_wo @ (guide.palm_pos[0] + share * way), R_wo @ mat

    pos, mat = palm_at(left)
    turn = norm(so3.log(mat @ motion.mat[PALM].T))
    misaligned = norm(pos - motion.pos[PALM]) + config.lever * turn
    # Aligned, the hand comes in; spoilt, it backs out.
    inwards = jnp.clip((config.aligned - misaligned) / config.aligned, -1.0, 1.0)
    step = config.speed * dt / config.length
    new = jnp.clip(left - step * inwards, 0.0, 1.0)
    rate = (new - left) / dt
    pos, mat = palm_at(new)
    goal = GuideGoal(
        known=guide.known,
        q=q[0] + new * q_way,
        palm_pos=pos,
        palm_mat=mat,
        offset=new * shift,
        left=jnp.where(guide.known, new, 0.0),
        astray=tracked.astray,
        q_rate=rate * q_way,
        palm_rate=rate * (R_wo @ way),
        offset_rate=rate * shift,
    )
    return goal, new
