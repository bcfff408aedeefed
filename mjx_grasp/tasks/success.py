"""The criterion of success and the exclusive failure classes (method §7)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.config import ClosingConfig


class Outcome(NamedTuple):
    """What has happened so far in an episode; the classes follow from it."""

    held_ticks: Int[Array, "*b"]
    """Ticks in a row at height without a slip."""
    success: Bool[Array, "*b"]
    lifted: Bool[Array, "*b"]
    """Whether the object ever reached the height."""
    slipped: Bool[Array, "*b"]
    """Whether it reached the height and then moved in the palm."""
    peak_rise: Float[Array, "*b"]
    """Largest rise [m]."""


def initial_outcome(batch: tuple[int, ...]) -> Outcome:
    """Nothing has happened."""
    no = jnp.zeros(batch, bool)
    return Outcome(jnp.zeros(batch, jnp.int32), no, no, no, jnp.zeros(batch))


def update_outcome(
    outcome: Outcome,
    rise: Float[Array, "*b"],
    displacement: Float[Array, "*b"],
    config: ClosingConfig,
) -> Outcome:
    """One control tick.

    Success: rise ≥ 0.10 m for 0.5 s without a break, palm-frame displacement since lift onset
    below 0.03 m all that time.

    Args:
        outcome: So far.
        rise: Object origin above its reset height [m].
        displacement: Of the object origin in the palm frame since lift onset [m].
        config: Thresholds.
    """
    high = rise >= config.success_height
    moved = displacement >= config.success_slip
    held = jnp.where(high & ~moved, outcome.held_ticks + 1, 0)
    needed = round(config.success_hold_s / config.control_dt)
    lifted = outcome.lifted | high
    return Outcome(
        held_ticks=held,
        success=outcome.success | (held >= needed),
        lifted=lifted,
        slipped=outcome.slipped | (lifted & moved),
        peak_rise=jnp.maximum(outcome.peak_rise, rise),
    )


FAILURES = ("never_lifted", "slipped", "not_held")


def failure_classes(outcome: Outcome) -> dict[str, Bool[Array, "*b"]]:
    """The failure class of each episode; exactly one is true where there is no success."""
    failed = ~outcome.success
    return {
        "never_lifted": failed & ~outcome.lifted,
        "slipped": failed & outcome.lifted & outcome.slipped,
        "not_held": failed & outcome.lifted & ~outcome.slipped,
    }
