"""Stage changes and the scripted lift, as pure functions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.config import GripConfig, LiftConfig, StageConfig


def lift_begins(
    touching: Bool[Array, "*b f"], time: Float[Array, "*b"], config: StageConfig
) -> Bool[Array, "*b"]:
    """All fingers touch, or at least two do after 1.6 s (method §5).

    Args:
        touching: Contact flags, solver or observer.
        time: Since the handoff [s].
        config: Times.
    """
    count = jnp.sum(touching, axis=-1)
    late = time >= config.acquisition_s - 1e-6
    return (count == touching.shape[-1]) | (late & (count >= config.fingers))


def lift_speed(time: Float[Array, "*b"], config: LiftConfig) -> Float[Array, "*b"]:
    """The trapezoid's speed at a time since lift onset [m/s]; it covers `height` in all."""
    time, ramp = time - config.delay_s, config.ramp_s
    duration = lift_duration(config) - config.delay_s
    share = jnp.minimum(time, duration - time) / max(ramp, 1e-9)
    return config.speed * jnp.clip(share, 0.0, 1.0)


def lift_duration(config: LiftConfig) -> float:
    """From lift onset to the end of the scripted motion [s]."""
    return config.delay_s + config.height / config.speed + config.ramp_s


def grip_share(time: Float[Array, "*b"], config: GripConfig) -> Float[Array, "*b"]:
    """How much of its force a finger presses with at a time since it landed or arrived [-]."""
    return jnp.clip(time / max(config.ramp_s, 1e-9), 0.0, 1.0)
