"""A robot that differs from its model: soft fingers, late commands, poor torque sensors."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_grasp.closing.joints import DrivenJoints
from mjx_grasp.robot.interface import Measured
from mjx_grasp.tasks.config import RobotErrors


class RobotDraw(NamedTuple):
    """What is random about a robot; it stays for an episode."""

    stiffness: Float[Array, " w"]
    """factor on the position gains of the fingers [-]"""
    latency: Float[Array, " w"]
    """of commands [s]"""
    friction: Float[Array, " w"]
    """error of the model of joint friction, as a share [-]"""
    stream: Int[Array, " w"]
    """of the noise of its torque sensors"""


def longest_delay(errors: RobotErrors, control_dt: float) -> int:
    """Commands that have to be remembered."""
    return round(errors.latency_s[1] / control_dt)


def arriving(
    command: Float[Array, "w n"],
    sent: tuple[Float[Array, "w n"], ...],
    draw: RobotDraw,
    measured: Measured,
    joints: DrivenJoints,
    control_dt: float,
) -> tuple[Float[Array, "w n"], tuple[Float[Array, "w n"], ...]]:
    """What a command becomes on its way to the actuators, and the commands on their way.

    A factor on a position gain is one on the actuator's position error, at the beginning of the
    control period.

    Args:
        command: Joint targets [rad].
        sent: Earlier ones, oldest first.
        draw: The robot.
        measured: When the command is sent.
        joints: Whose gains differ.
        control_dt: Control period [s].
    """
    if sent:
        sent = (*sent, command)
        delay = jnp.round(draw.latency / control_dt).astype(jnp.int32)
        delay = jnp.minimum(delay, len(sent) - 1)  # halves may be rounded up here alone
        command = jnp.stack(sent)[len(sent) - 1 - delay, jnp.arange(len(command))]
        sent = sent[1:]
    fingers = joints.at.fingers
    error = command[:, fingers] - measured.q[:, fingers]
    return command.at[:, fingers].add((draw.stiffness[:, None] - 1.0) * error), sent


def as_sensed(
    measured: Measured,
    draw: RobotDraw,
    tick: Int[Array, " w"],
    joints: DrivenJoints,
    errors: RobotErrors,
) -> Measured:
    """What a robot with poor sensors and a poor model of friction takes its torques for.

    Args:
        measured: What a perfect one measures.
        draw: The robot.
        tick: Control periods so far.
        joints: Whose friction is known badly.
        errors: How poor.
    """
    if not errors.of_torque:
        return measured
    torque, qd = measured.external_torque, measured.qd[:, joints.at.grasping]
    if errors.friction:
        friction = joints.dry_friction * jnp.tanh(qd / _STICKING) + joints.damping * qd
        torque = torque + (draw.friction[:, None] * friction)[:, None]
    if errors.torque_std:
        keys = jax.vmap(lambda s, t: jax.random.fold_in(jax.random.PRNGKey(s), t))(
            draw.stream, tick
        )
        noise = jax.vmap(lambda key: jax.random.normal(key, torque.shape[1:]))(keys)
        torque = torque + errors.torque_std * noise
    if errors.torque_step:
        torque = errors.torque_step * jnp.round(torque / errors.torque_step)
    return measured._replace(external_torque=torque)


_STICKING = 0.02
"""Speed at which dry friction has found its direction [rad/s]."""
