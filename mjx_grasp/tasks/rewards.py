"""The reward terms of the closing task (method §5), each a pure function of what it looks at."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.config import ClosingConfig
from mjx_grasp.closing.guidance import twist_norm


def reach(
    pad_twist: Float[Array, "*b f 6"], guidance: Float[Array, "*b f 6"], config: ClosingConfig
) -> Float[Array, "*b"]:
    """mean_f exp(−‖v_f − GVF_f‖_w / (s(‖GVF_f‖_w + ε))): the pads move as the field says."""
    error = twist_norm(pad_twist - guidance, config.angular_weight)
    scale = config.reach_scale * (twist_norm(guidance, config.angular_weight) + config.reach_floor)
    return jnp.mean(jnp.exp(-error / scale), axis=-1)


def contact(touching: Bool[Array, "*b f"]) -> Float[Array, "*b"]:
    """The number of fingertips that touch the object."""
    return jnp.sum(touching, axis=-1).astype(jnp.float32)


def lift(
    palm_velocity: Float[Array, "*b 3"], speed: Float[Array, "*b"], config: ClosingConfig
) -> Float[Array, "*b"]:
    """exp(−((v_z − v*)/σ)²)·exp(−(|v_xy|/σ)²): the palm rises at the scripted speed, straight.

    `speed` is the scripted lift's own at this time: 0.15 m/s as published, 0 once it has ended,
    so that the reward never asks for more height than the script.
    """
    up = (palm_velocity[..., 2] - speed) / config.lift_reward_scale
    sideways = jnp.sum(palm_velocity[..., :2] ** 2, -1) / config.lift_reward_scale**2
    return jnp.exp(-(up**2) - sideways)


def action_rate(
    action: Float[Array, "*b a"], last: Float[Array, "*b a"], config: ClosingConfig
) -> Float[Array, "*b"]:
    """−0.01·|a_t − a_{t−1}|²."""
    return config.action_rate_weight * jnp.sum((action - last) ** 2, -1)


def action_acceleration(
    action: Float[Array, "*b a"],
    last: Float[Array, "*b a"],
    before_last: Float[Array, "*b a"],
    config: ClosingConfig,
) -> Float[Array, "*b"]:
    """−0.005·|a_t − 2a_{t−1} + a_{t−2}|²."""
    second = action - 2.0 * last + before_last
    return config.action_acceleration_weight * jnp.sum(second**2, -1)


def total(
    lifting: Bool[Array, "*b"],
    pad_twist: Float[Array, "*b f 6"],
    guidance: Float[Array, "*b f 6"],
    touching: Bool[Array, "*b f"],
    palm_velocity: Float[Array, "*b 3"],
    lift_speed: Float[Array, "*b"],
    actions: tuple[Float[Array, "*b a"], Float[Array, "*b a"], Float[Array, "*b a"]],
    config: ClosingConfig,
) -> Float[Array, "*b"]:
    """The reward of a tick: reach + contact while acquiring, lift + contact while lifting.

    Args:
        lifting: The stage.
        pad_twist: Measured pad twists [m/s, rad/s].
        guidance: The field at the pads.
        touching: Fingertip contacts with the object.
        palm_velocity: Palm velocity [m/s].
        lift_speed: Scripted speed [m/s].
        actions: This action, the last, and the one before it.
        config: Weights.
    """
    task = jnp.where(
        lifting,
        config.lift_weight * lift(palm_velocity, lift_speed, config),
        config.reach_weight * reach(pad_twist, guidance, config),
    )
    smooth = action_rate(*actions[:2], config) + action_acceleration(*actions, config)
    return task + config.contact_weight * contact(touching) + smooth
