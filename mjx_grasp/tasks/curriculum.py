"""How far from the object the episodes of a training begin, as the training goes on (method §6).

The level is kept in the worlds' state, the same in every world: a learner raises it between two
iterations (`PacedTask.paced`), resets read it, and checkpoints keep it with the worlds, on whatever
number of devices. A training whose worlds start anew begins at the first level again, and forced
it is where it should be after one iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.records.settings import Count, Range, Settings, Share


@dataclass(frozen=True)
class CurriculumConfig(Settings):
    """Up to which share of the way home the episodes of a training begin."""

    kind: Literal["none", "forced", "measured"] = "forced"
    """none: anywhere on the way, from the first iteration on; forced: up to a share that rises
    evenly with the iterations; measured: up to one that rises where enough episodes succeed"""
    start: Share = 0.1
    """the share at first [-]"""
    frontier: Share = 0.0
    """share of the episodes that begin just there; the others anywhere up to it, evenly [-]"""
    until: Share = 0.5
    """how much of the training is done when it is the whole way, whatever the success [-]"""
    step: Annotated[float, Range(0, 1, above=True)] = 0.1
    """measured: by how much it rises [-]"""
    success: Share = 0.5
    """measured: share of a window's episodes that have to succeed for that [-]"""
    window: Count = 1000
    """measured: finished episodes that are counted, then the next are [-]"""


class Learnt(NamedTuple):
    """How far a training has come, over all its devices."""

    share: Float[Array, ""]
    """of its iterations that are done [-]"""
    episodes: Float[Array, ""]
    """whole ones that ended in the last iteration"""
    successes: Float[Array, ""]
    """among them"""


class Pace(NamedTuple):
    """Where the curriculum stands; the same in every world."""

    level: Float[Array, " w"]
    """share of the way home up to which episodes begin [-]"""
    episodes: Float[Array, " w"]
    """of the window, so far"""
    successes: Float[Array, " w"]
    """among them"""


def first_pace(worlds: int, config: CurriculumConfig) -> Pace:
    """Before the first iteration."""
    zeros = jnp.zeros(worlds)
    level = 1.0 if config.kind == "none" else config.start
    return Pace(jnp.full(worlds, level, jnp.float32), zeros, zeros)


def next_pace(pace: Pace, learnt: Learnt, config: CurriculumConfig) -> Pace:
    """After an iteration.

    Args:
        pace: Before.
        learnt: How far the training has come.
        config: The curriculum.
    """
    if config.kind == "none":
        return pace
    done = learnt.share >= config.until
    if config.kind == "forced":
        way = learnt.share / max(config.until, 1e-6)
        level = config.start + (1.0 - config.start) * jnp.clip(way, 0.0, 1.0)
        return pace._replace(level=jnp.where(done, 1.0, jnp.full_like(pace.level, level)))
    episodes = pace.episodes + learnt.episodes
    successes = pace.successes + learnt.successes
    whole = episodes >= config.window
    rises = whole & (successes >= config.success * episodes)
    level = jnp.minimum(pace.level + jnp.where(rises, config.step, 0.0), 1.0)
    return Pace(
        level=jnp.where(done, 1.0, level),
        episodes=jnp.where(whole, 0.0, episodes),
        successes=jnp.where(whole, 0.0, successes),
    )
