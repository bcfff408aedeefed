"""Task-space velocities: fingertips, pads, and the posture of the hand (method §3)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.geometry.vectors import angle_between, norm, unit
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.surroundings import Surroundings, obstacle_distance, to_object
from mjx_grasp.reaching.config import FieldConfig, GuideConfig, ReachConfig
from mjx_grasp.reaching.guide import GuideGoal

# One violation of clearance counts more than any way round can be long, [m].
_VIOLATION = 10.0


def gate(value: Array, threshold: float, width: float) -> Array:
    """``g(e; a, b) = ½(1 + tanh((e − a)/b))``: 0 well below the threshold, 1 well above."""
    return 0.5 * (1.0 + jnp.tanh((value - threshold) / width))


def midpoint(points: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """½ thumb + ¼ first wrap + ¼ second wrap."""
    return 0.5 * points[0] + 0.25 * (points[1] + points[2])


def sphere_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Evenly spread unit vectors (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    rho = np.sqrt(1.0 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=-1).astype(np.float32)


def clearance(around: Surroundings, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Distance in [m] of world points to the nearest of object and obstacles."""
    to_shape = signed_distance(around.shape, to_object(around, points))
    return jnp.minimum(to_shape, obstacle_distance(around.obstacles, points))


def _violations(
    around: Surroundings,
    start: Float[Array, "*#n 3"],
    end: Float[Array, "*#n 3"],
    config: FieldConfig,
) -> Float[Array, "*n"]:
    """How many samples of segments are not clear; the start is where it is and does not count."""
    share = jnp.arange(1, config.path_samples + 1) / config.path_samples
    points = start[..., None, :] + share[:, None] * (end - start)[..., None, :]
    near = clearance(around, points) < config.path_clearance
    return jnp.sum(near.astype(start.dtype), axis=-1)


def way_points(
    tips: Float[Array, "3 3"],
    goals: Float[Array, "3 3"],
    around: Surroundings,
    config: FieldConfig,
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"]]:
    """Where each tip heads next, and how long its way is, [m].

    The goal itself where the straight way to it is clear; else the best of the via-points on a
    sphere around it: fewest violations, then shortest.
    """
    length = norm(goals - tips)
    if config.via_points == 0:
        return goals, length
    blocked = _violations(around, tips, goals, config) > 0
    vias = goals[:, None] + config.via_radius * sphere_directions(config.via_points)
    first = _violations(around, tips[:, None], vias, config)
    second = _violations(around, vias, goals[:, None], config)
    detour = norm(vias - tips[:, None]) + config.via_radius
    best = jnp.argmin(_VIOLATION * (first + second) + detour, axis=-1)
    rows = jnp.arange(len(tips))
    heading = jnp.where(blocked[:, None], vias[rows, best], goals)
    return heading, jnp.where(blocked, detour[rows, best], length)


def tip_velocities(
    tips: Float[Array, "3 3"],
    heading: Float[Array, "3 3"],
    length: Float[Array, " 3"],
    config: FieldConfig,
    dt: float,
) -> Float[Array, "3 3"]:
    """Along the straight line to where each tip heads, slowing down towards the end, [m/s].

    ``min(v·min(1, e/e_slow), e/dt)`` with e the length of the way to the goal.
    """
    speed = config.speed * jnp.minimum(1.0, length / config.slow_down)
    return jnp.minimum(speed, length / dt)[:, None] * unit(heading - tips)


def pad_goals(goals: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Where pad normals shall point: wraps to the thumb's target, the thumb between the wraps'."""
    opposite = 0.5 * (goals[1] + goals[2])
    return unit(jnp.stack([opposite - goals[0], goals[0] - goals[1], goals[0] - goals[2]]))


def pad_rotation(
    normals: Float[Array, "3 3"],
    wanted: Float[Array, "3 3"],
    midpoint_error: Float[Array, ""],
    config: FieldConfig,
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"]]:
    """Angular velocities ``k·n × n*`` of the pads [rad/s], and their weights [m²/rad²]."""
    angle = angle_between(normals, wanted)
    weight = gate(angle, *config.orientation_angle) * (1.0 - gate(midpoint_error, *config.arrival))
    return config.orientation_gain * jnp.cross(normals, wanted), config.orientation_weight * weight


def posture_velocity(
    body: Body,
    q: Float[Array, " joints"],
    guide: GuideGoal,
    midpoint_error: Float[Array, ""],
    config: ReachConfig,
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Joint velocities of the posture [rad/s], and their weights [m²/rad²].

    Far away the hand goes to the open posture. With a guide, arm and hand go to its configuration,
    all joints in proportion, so that they arrive together.
    """
    field = config.fields
    arm = jnp.asarray(body.arm)
    far = gate(midpoint_error, *field.far)
    v_open = field.posture_gain * (jnp.asarray(body.home) - q)
    v_open = jnp.clip(v_open, -field.posture_speed, field.posture_speed)
    w_open = jnp.where(arm, 0.0, far * field.posture_weight)
    v_guide = field.posture_gain * (guide.q - q) + guide.q_rate
    most = jnp.max(jnp.abs(v_guide) / body.velocity_limit)
    v_guide = v_guide / jnp.maximum(most, 1.0)
    settled = config.guide.settled_arm_weight
    w_arm = settled + guide.left * (config.guide.arm_weight - settled)
    w_arm = w_arm * (1.0 - guide.astray)
    w_guide = jnp.where(arm, w_arm, config.guide.hand_weight)
    return jnp.where(guide.known, v_guide, v_open), jnp.where(guide.known, w_guide, w_open)


def palm_twist(
    pos: Float[Array, " 3"], mat: Float[Array, "3 3"], guide: GuideGoal, config: GuideConfig
) -> tuple[Float[Array, " 6"], Float[Array, " 6"]]:
    """Twist of the palm towards the guide's pose, [m/s] and [rad/s], and its weights."""
    way = guide.palm_pos - pos
    turn = so3.log(guide.palm_mat @ mat.T)

    def limited(v: Float[Array, " 3"], most: float) -> Float[Array, " 3"]:
        return v / jnp.maximum(norm(v) / most, 1.0)

    linear = limited(config.palm_gain * way + guide.palm_rate, config.palm_speed)
    angular = limited(config.palm_gain * turn, config.palm_speed / config.lever)
    twist = jnp.concatenate([linear, angular])
    weight = jnp.repeat(jnp.asarray([config.palm_weight, config.palm_turn_weight]), 3)
    weight = weight * (1.0 + guide.astray * (config.astray_palm - 1.0))
    return twist, jnp.where(guide.known, weight, 0.0)
