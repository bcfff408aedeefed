"""One tick of control: from targets and surroundings to a joint velocity (method §3, 'QP')."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.linear import full_precision
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.clearances import proximities, row_count, table_clearances
from mjx_grasp.posture.surroundings import Proximity, Surroundings, stacked
from mjx_grasp.reaching import fields
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.guide import GuideGoal
from mjx_grasp.reaching.qp import QP, WarmStart, cold_start, solve_qp
from mjx_grasp.robot.kinematics import Motion

# How the escape speed that is asked for changes from tick to tick, where it cannot and can be had.
_LESS, _MORE = 0.5, 1.1
_TINY = 1e-9
# Of the margin, what a command that is scaled back leaves.
_ROOM = 0.25


class Goals(NamedTuple):
    """Where the hand is to be; world frame."""

    tips: Float[Array, "3 3"]
    """standoff targets of the tip frames [m]"""
    pads: Float[Array, "3 3"]
    """unit directions for the pad normals"""
    guide: GuideGoal
    """where a plan wants the whole hand"""


class Memory(NamedTuple):
    """What one tick leaves to the next."""

    command: Float[Array, " joints"]
    """the last command [rad/s]"""
    escape: Float[Array, ""]
    """share of the escape speed that is asked for; less while it cannot be had [-]"""
    warm: WarmStart
    """the solver's"""


class Programme(NamedTuple):
    """The quadratic programme of a tick, and what it is made of."""

    problem: QP
    """its solution is the command"""
    motion: Motion
    """the robot"""
    tip_rows: Float[Array, "3 3 joints"]
    """velocities of the tips per joint velocity"""
    midpoint: Float[Array, ""]
    """error of the midpoint [m]"""
    near: dict[str, Proximity]
    """distances, by kind"""


class Report(NamedTuple):
    """What a tick found and did."""

    error: Float[Array, " 3"]
    """tip frames to standoff targets [m]"""
    midpoint: Float[Array, ""]
    """of midpoints [m]"""
    speed: Float[Array, " 3"]
    """of the tips under the command [m/s]"""
    feasible: Bool[Array, ""]
    """whether the programme had a solution; where not, the command is zero, or escapes"""
    violation: Float[Array, ""]
    """of the half-spaces by the solver's answer [m/s]"""
    object_distance: Float[Array, ""]
    """least distance of the robot to the object [m]"""
    obstacle_distance: Float[Array, ""]
    """to the obstacles [m]"""
    table_margin: Float[Array, ""]
    """least height above the table over what is asked for [m]"""
    finger_distance: Float[Array, ""]
    """least distance of two fingers [m]"""
    arm_distance: Float[Array, ""]
    """least distance of the arm's outer links to its base and inner links [m]"""


def start_memory(body: Body, obstacles: int) -> Memory:
    """The memory at rest."""
    joints = len(body.lower)
    warm = cold_start(joints, row_count(body, obstacles))
    return Memory(jnp.zeros(joints), jnp.float32(1.0), warm)


def half_spaces(
    body: Body, motion: Motion, around: Surroundings, config: ReachConfig
) -> tuple[Float[Array, "m joints"], Float[Array, " m"], dict[str, Proximity]]:
    """``n̂ᵀJ x ≥ min((d_safe + margin − d)/H, v_escape)`` for all that must stay apart.

    Returns:
        The rows, their bounds in [m/s], and the distances by kind.
    """
    limits = config.limits
    near, safe = proximities(body, motion, around, limits.clearances)
    everything = stacked(list(near.values()))
    drift = everything.drift if limits.follow_object else 0.0
    bound = (safe + limits.margin - everything.distance) / limits.horizon
    bound = jnp.minimum(bound - drift, limits.escape_speed)
    return everything.slope, bound, near


class _Shortening(NamedTuple):
    """A command on its way to one that holds."""

    x: Float[Array, " joints"]
    """that comes next [rad/s]"""
    checked: Float[Array, " joints"]
    """that was looked at last [rad/s]"""
    holds: Bool[Array, ""]
    """whether that one keeps all distances"""


def scaled_back(
    body: Body,
    config: ReachConfig,
    q: Float[Array, " joints"],
    x: Float[Array, " joints"],
    around: Surroundings,
    near: dict[str, Proximity],
) -> Float[Array, " joints"]:
    """A command, less of it where its tick would end too near to something.

    A half-space bounds the point that is nearest now. Another one may be nearest at the end of the
    tick: there no distance may be less than its clearance and less than if the robot had stood
    still. What is in contact has no clearance to lose.

    Args:
        body: The robot.
        config: Settings.
        q: Configuration, [rad].
        x: The command, [rad/s].
        around: Object and obstacles.
        near: Distances now.
    """
    dt, limits = config.controller.dt, config.limits
    clearances = limits.clearances
    later = around.after(dt) if limits.follow_object else around

    def after(x: Float[Array, " joints"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        then, safe = proximities(body, body.kinematics.motion(q + dt * x), later, clearances)
        return stacked(list(then.values())).distance, safe

    now = stacked(list(near.values()))
    still = now.distance + (dt * now.drift if limits.follow_object else 0.0)

    # Distances are not linear in the joints: what is left of the command has to show that it holds.
    def shortened(state: _Shortening) -> _Shortening:
        x = state.x
        moved, safe = after(x)
        least = jnp.minimum(still, safe + _ROOM * limits.margin)
        share = (still - least) / jnp.maximum(still - moved, _TINY)
        shorter = jnp.min(jnp.where((moved < least) & (still > 0), share, 1.0)) * x
        holds = (moved >= jnp.minimum(still, safe)) | (still <= 0)
        return _Shortening(shorter, x, jnp.all(holds))

    def unless_settled(_: Array, state: _Shortening) -> _Shortening:
        # What holds and needs no shortening is not looked at again, but in a batch, where `cond`
        # does both.
        settled = state.holds & jnp.all(state.x == state.checked)
        return jax.lax.cond(settled, lambda s: s, shortened, state)

    # A loop, so that the distances are compiled once.
    begin = _Shortening(x, x, jnp.array(False))
    _, checked, holds = jax.lax.fori_loop(0, 2, unless_settled, begin)
    return jnp.where(holds, checked, 0.0)


def velocity_box(
    body: Body, q: Float[Array, " joints"], config: ReachConfig
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Velocity limits, and position limits over the horizon, [rad/s]; never empty."""
    limits = config.limits
    lower, upper = body.within(limits.clearances.joint_limits)
    to_lower = (lower - q) / limits.horizon
    to_upper = (upper - q) / limits.horizon
    most = body.velocity_limit
    return jnp.clip(to_lower, -most, most), jnp.clip(to_upper, -most, most)


def command(
    body: Body,
    config: ReachConfig,
    q: Float[Array, " joints"],
    goals: Goals,
    around: Surroundings,
    memory: Memory,
) -> tuple[Float[Array, " joints"], Memory, Report]:
    """The joint velocity for this tick.

    Args:
        body: The robot.
        config: Settings.
        q: Configuration, [rad].
        goals: Where tips and pads are to be.
        around: Object and obstacles.
        memory: From the last tick.

    Returns:
        The command in [rad/s], the memory, and what was found.
    """
    problem, motion, tip_rows, middle, near = programme(body, config, q, goals, around, memory)
    solution = solve_qp(problem, memory.warm, config.solver)
    feasible = solution.violation <= config.solver.feasible
    used, escape = feasible, memory.escape
    if config.solver.partial_escape:
        worsens = jnp.max(jnp.minimum(problem.b, 0.0) - problem.A @ solution.x)
        used |= worsens <= config.solver.feasible
        escape = jnp.where(used, jnp.minimum(_MORE * escape, 1.0), _LESS * escape)
    x = jnp.where(used, solution.x, 0.0)
    if config.limits.margin > 0:
        x = scaled_back(body, config, q, x, around, near)
    obstacle = near["obstacles"].distance if "obstacles" in near else jnp.full(1, jnp.inf)
    table = near["table"].distance - jnp.asarray(table_clearances(body, config.limits.clearances))
    report = Report(
        error=norm(motion.pos[:FINGERS] - goals.tips),
        midpoint=middle,
        speed=norm(tip_rows @ x),
        feasible=feasible,
        violation=solution.violation,
        object_distance=jnp.min(near["object"].distance),
        obstacle_distance=jnp.min(obstacle),
        table_margin=jnp.min(table),
        finger_distance=jnp.min(near["fingers"].distance),
        arm_distance=jnp.min(near["arm"].distance, initial=jnp.inf),
    )
    return x, Memory(x, escape, solution.warm), report


@full_precision
def programme(
    body: Body,
    config: ReachConfig,
    q: Float[Array, " joints"],
    goals: Goals,
    around: Surroundings,
    memory: Memory,
) -> Programme:
    """The quadratic programme whose solution is the command; arguments as of :func:`command`."""
    motion = body.kinematics.motion(q)
    tips, pads = motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]
    middle = norm(fields.midpoint(tips) - fields.midpoint(goals.tips))
    tip_rows = body.point_jacobians(motion, np.arange(FINGERS), tips)
    heads_for = goals.tips + goals.guide.offset
    heading, length = fields.way_points(tips, heads_for, around, config.fields)
    v_tips = fields.tip_velocities(tips, heading, length, config.fields, config.controller.dt)
    v_tips = v_tips + goals.guide.offset_rate
    if config.limits.follow_object:
        v_tips = v_tips + around.v_wo[:3] + jnp.cross(around.v_wo[3:], goals.tips - around.p_wo)
    turn, turn_weight = fields.pad_rotation(pads, goals.pads, middle, config.fields)
    turning = body.angular_jacobians(motion, np.arange(FINGERS, PALM))
    # A pad may spin about its own normal as it likes.
    along = jnp.einsum("fk,fkj->fj", pads, turning)
    turning = turning - pads[:, :, None] * along[:, None, :]

    v_posture, w_posture = fields.posture_velocity(body, q, goals.guide, middle, config)
    root = jnp.sqrt(turn_weight)[:, None]
    v_palm, w_palm = fields.palm_twist(
        motion.pos[PALM], motion.mat[PALM], goals.guide, config.guide
    )
    palm_root = jnp.sqrt(w_palm)
    left = goals.guide.left
    tip_root = jnp.sqrt(1.0 + left * (config.guide.tip_weight - 1.0))
    palm = np.array([PALM])
    palm_rows = jnp.concatenate(
        [
            body.point_jacobians(motion, palm, motion.pos[palm])[0],
            body.angular_jacobians(motion, palm)[0],
        ]
    )
    rows = jnp.concatenate(
        [
            tip_root * tip_rows.reshape(9, -1),
            (root[:, :, None] * turning).reshape(9, -1),
            palm_root[:, None] * palm_rows,
        ]
    )
    wanted = jnp.concatenate(
        [tip_root * v_tips.reshape(-1), (root * turn).reshape(-1), palm_root * v_palm]
    )
    solver = config.solver
    effort = jnp.where(jnp.asarray(body.arm), solver.arm_effort, solver.hand_effort)
    diagonal = effort + solver.smoothness + w_posture
    P = rows.T @ rows + jnp.diag(diagonal)
    linear = -(rows.T @ wanted) - solver.smoothness * memory.command - w_posture * v_posture
    A, b, near = half_spaces(body, motion, around, config)
    b = jnp.minimum(b, memory.escape * config.limits.escape_speed)
    lower, upper = velocity_box(body, q, config)
    return Programme(QP(P, linear, A, b, lower, upper), motion, tip_rows, middle, near)
