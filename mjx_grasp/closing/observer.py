"""The generalized-momentum observer and the contact flags made from it (method §5)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.config import ObserverConfig
from mjx_grasp.errors import InputError


class ObserverState(NamedTuple):
    """Estimated external torques and how long each finger has looked like touching."""

    torque: Float[Array, "*b g"]
    """τ̂ of the fingers' joints, finger by finger [N m]."""
    ticks: Int[Array, "*b f"]


def initial_observer(batch: tuple[int, ...], joints: int, fingers: int) -> ObserverState:
    """An observer that has seen nothing."""
    return ObserverState(jnp.zeros((*batch, joints)), jnp.zeros((*batch, fingers), jnp.int32))


def observe(
    state: ObserverState,
    residual: Float[Array, "*b s g"],
    q: Float[Array, "*b g"],
    qd: Float[Array, "*b g"],
    limits: Float[np.ndarray, "g 2"],
    dry_friction: Float[np.ndarray, " g"],
    dt: float,
    config: ObserverConfig,
) -> tuple[ObserverState, Bool[Array, "*b f"]]:
    """One control tick: r⁺ = (r + K·dt·τ_ext)/(1 + K·dt) per physics step, then the flags.

    A finger touches when its joints have stalled and one of them bears more torque than dry
    friction and the threshold explain, `contact_ticks` ticks in a row. Joints near a stop are
    left out: the residual cannot tell a stop from a contact.

    Args:
        state: The observer.
        residual: τ_ext, `Measured.external_torque` [N m].
        q: Positions of these joints [rad].
        qd: Their velocities [rad/s].
        limits: Their ranges [rad].
        dry_friction: Their friction losses [N m].
        dt: Control period [s].
        config: Gains and thresholds.

    Raises:
        InputError: Not one torque of each of these joints.
    """
    if residual.shape[-1] != len(dry_friction):
        expected = f"{len(dry_friction)}, one of each joint of thumb and wraps"
        raise InputError("external_torque", f"{residual.shape[-1]} columns", expected)
    gain = config.gain * dt / residual.shape[-2]
    torque = state.torque
    for s in range(residual.shape[-2]):
        torque = (torque + gain * residual[..., s, :]) / (1.0 + gain)
    free = (q > limits[:, 0] + config.stop_margin) & (q < limits[:, 1] - config.stop_margin)
    beyond = jnp.where(free, jnp.maximum(jnp.abs(torque) - dry_friction, 0.0), 0.0)
    fingers = state.ticks.shape[-1]

    def largest(x: Float[Array, "*b g"]) -> Float[Array, "*b f"]:
        return jnp.max(x.reshape(*x.shape[:-1], fingers, -1), axis=-1)

    touching = (largest(jnp.abs(qd)) < config.stall_speed) & (
        largest(beyond) > config.contact_torque
    )
    ticks = jnp.where(touching, state.ticks + 1, 0)
    return ObserverState(torque, ticks), ticks >= config.contact_ticks
