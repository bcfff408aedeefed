"""The criterion of success and the exclusive failure classes (method §7)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Truth
from mjx_grasp.tasks.config import SuccessConfig


class Progress(NamedTuple):
    """What has happened so far in an episode; the classes follow from it."""

    held_ticks: Int[Array, "*b"]
    """Ticks in a row in which it is lifted to the height without a slip."""
    success: Bool[Array, "*b"]
    lifted: Bool[Array, "*b"]
    """Whether the object ever reached the height in a lift."""
    slipped: Bool[Array, "*b"]
    """Whether it reached the height and then moved in the palm."""
    peak_rise: Float[Array, "*b"]
    """Largest rise [m]."""


def initial_progress(batch: tuple[int, ...]) -> Progress:
    """Nothing has happened."""
    no = jnp.zeros(batch, bool)
    return Progress(jnp.zeros(batch, jnp.int32), no, no, no, jnp.zeros(batch))


def update_progress(
    progress: Progress,
    rise: Float[Array, "*b"],
    displacement: Float[Array, "*b"],
    lifting: Bool[Array, "*b"],
    config: SuccessConfig,
    control_dt: float,
) -> Progress:
    """One control tick.

    Success: rise ≥ 0.10 m for 0.5 s without a break, palm-frame displacement since lift onset
    below 0.03 m all that time. What rises without a lift is not lifted.

    Args:
        progress: So far.
        rise: Object origin above its reset height [m].
        displacement: Of the object origin in the palm frame since lift onset, see `slipped` [m].
        lifting: Whether the controller lifts, or holds what it has lifted.
        config: Thresholds.
        control_dt: Control period [s].
    """
    high = lifting & (rise >= config.height)
    moved = displacement >= config.slip
    held = jnp.where(high & ~moved, progress.held_ticks + 1, 0)
    needed = max(round(config.hold_s / control_dt), 1)
    lifted = progress.lifted | high
    return Progress(
        held_ticks=held,
        success=progress.success | (held >= needed),
        lifted=lifted,
        slipped=progress.slipped | (lifted & moved),
        peak_rise=jnp.maximum(progress.peak_rise, rise),
    )


def in_palm(measured: Measured, truth: Truth) -> Float[Array, "*b 3"]:
    """Object origin in the palm frame [m]; how far it moves there is a grasp's slip."""
    offset = truth.object_pos - measured.palm_pos
    return jnp.sum(measured.palm_mat * offset[..., :, None], axis=-2)


def slipped(
    reference: Float[Array, "*b 3"],
    before: Bool[Array, "*b"],
    lifting: Bool[Array, "*b"],
    here: Float[Array, "*b 3"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Where the object was in the palm at lift onset, and how far it is from there now [m].

    Args:
        reference: The former as of the tick before [m].
        before: Whether the controller was lifting in that tick.
        lifting: Whether it is; nothing slips in a hand that does not lift.
        here: The object in the palm now, see `in_palm` [m].
    """
    reference = jnp.where(before[..., None], reference, here)
    moved = jnp.linalg.norm(here - reference, axis=-1)
    return reference, jnp.where(lifting, moved, 0.0)


FAILURES = ("never_lifted", "slipped", "not_held")


def failure_classes(progress: Progress) -> dict[str, Bool[Array, "*b"]]:
    """The failure class of each episode; exactly one is true where there is no success."""
    failed = ~progress.success
    return {
        "never_lifted": failed & ~progress.lifted,
        "slipped": failed & progress.lifted & progress.slipped,
        "not_held": failed & progress.lifted & ~progress.slipped,
    }
