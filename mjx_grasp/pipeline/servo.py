"""Position targets for joint servos from the velocities that reaching commands."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.pipeline.config import ServoConfig
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import robot_mjspec


class Servos(NamedTuple):
    """Constants of a robot's joint servos. Static."""

    lag: Float[np.ndarray, " n"]
    """by which a joint at constant velocity is behind its target [s]"""
    lower: Float[np.ndarray, " n"]
    """position limits [rad]"""
    upper: Float[np.ndarray, " n"]
    """position limits [rad]"""


def joint_servos(robot: RobotSpec) -> Servos:
    """Reads the constants off the robot's compiled MJCF.

    Of a position servo with gain k_p whose joint is damped by k_v in all, the lag is k_v / k_p.
    """
    model = robot_mjspec(robot).compile()
    joints = [model.joint(name) for name in robot.joints]
    actuators = [model.actuator(name).id for name in robot.joints]
    damping = np.array([model.dof_damping[j.dofadr[0]] for j in joints])
    damping = damping - model.actuator_biasprm[actuators, 2]
    lower, upper = np.array([j.range for j in joints], np.float32).T
    lag = damping / model.actuator_gainprm[actuators, 0]
    return Servos(lag.astype(np.float32), lower, upper)


def follow_velocity(
    reference: Float[Array, " n"],
    q: Float[Array, " n"],
    velocity: Float[Array, " n"],
    dt: float,
    servos: Servos,
    config: ServoConfig,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The integrated reference after a control period, and the targets that make joints follow it.

    Args:
        reference: Before; at the start where the joints are [rad].
        q: Measured joint positions [rad].
        velocity: Commanded [rad/s].
        dt: Control period [s].
        servos: The robot's.
        config: How far the reference may lead.
    """
    moved = reference + dt * velocity
    moved = jnp.clip(moved, q - config.lead, q + config.lead)
    moved = jnp.clip(moved, servos.lower, servos.upper)
    target = moved + config.feed_forward * servos.lag * velocity
    return moved, jnp.clip(target, servos.lower, servos.upper)
