"""Stage changes and the scripted lift, as pure functions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.config import ClosingConfig


def lift_begins(
    touching: Bool[Array, "*b f"], tick: Int[Array, "*b"], config: ClosingConfig
) -> Bool[Array, "*b"]:
    """All fingers touch, or at least two do after 1.6 s (method §5).

    Args:
        touching: Contact flags, solver or observer.
        tick: Control ticks since the handoff.
        config: Times.
    """
    count = jnp.sum(touching, axis=-1)
    late = tick * config.control_dt >= config.acquisition_s - 1e-6
    return (count == touching.shape[-1]) | (late & (count >= config.acquisition_fingers))


def lift_speed(time: Float[Array, "*b"], config: ClosingConfig) -> Float[Array, "*b"]:
    """The trapezoid's speed at a time since lift onset [m/s]; it covers `lift_height` in all."""
    time, ramp = time - config.lift_delay_s, config.lift_ramp_s
    duration = config.lift_height / config.lift_speed + ramp
    share = jnp.minimum(time, duration - time) / max(ramp, 1e-9)
    return config.lift_speed * jnp.clip(share, 0.0, 1.0)


def grip_force(
    ticks_since_landing: Int[Array, "*b"], config: ClosingConfig, force: Float[Array, "*b"] | float
) -> Float[Array, "*b"]:
    """The commanded force of a finger [N]: 0 when it lands or arrives, `force` after the ramp."""
    time = ticks_since_landing * config.control_dt
    return force * jnp.clip(time / max(config.grip_ramp_s, 1e-9), 0.0, 1.0)
