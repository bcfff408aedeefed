"""New plans for some worlds of many, by one compiled function."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Tried, Ways
from mjx_grasp.posture.library import Library

_TOGETHER = 128
"""Worlds that a GPU plans for at once, few in hardly less time; a CPU plans for one at a time."""


class Wanted(NamedTuple):
    """What is planned for, of all worlds, stacked."""

    known: Known
    seen: Seen
    q: Float[Array, "w n"]
    """measured joint positions [rad]"""
    tried: Tried
    """see `Grasper.plan`"""
    key: Array
    """of what is tried at random"""


def planned(
    grasper: Grasper,
    library: Library | None,
    wanted: Wanted,
    rows: Int[np.ndarray, " k"],
    together: int | None = None,
) -> Ways | None:
    """Plans of some worlds; None where the controller makes none.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        wanted: What is planned for, in all worlds.
        rows: The worlds, one at least.
        together: So many are planned for at once; by default what the device does best.
    """
    if library is None:
        return None
    parts = planned_in_parts(grasper, library, wanted, rows, together)
    found = [jax.device_get(ways) for _, ways in parts]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(rows)], *found)


def planned_in_parts(
    grasper: Grasper,
    library: Library,
    wanted: Wanted,
    rows: Int[np.ndarray, " k"],
    together: int | None = None,
) -> Iterator[tuple[Int[Array, " part"], Ways]]:
    """Worlds and their plans, some at a time; arguments as of `planned`.

    All parts are of the same size: the last one is filled up with a world behind the last one.
    """
    together = together or (1 if jax.default_backend() == "cpu" else _TOGETHER)
    for first in range(0, len(rows), together):
        part = np.full(together, len(wanted.q), np.int32)
        some = rows[first : first + together]
        part[: len(some)] = some
        rows_of_part = jnp.asarray(part)
        yield rows_of_part, _plans(grasper, library, _own(wanted, rows_of_part))


@jax.jit
def _own(wanted: Wanted, rows: Int[Array, " part"]) -> Wanted:
    """What some worlds want.

    Apart from the search, whose compiled function takes minutes on a GPU and so does not depend on
    how many worlds there are.
    """
    rows = jnp.minimum(rows, len(wanted.q) - 1)
    return jax.tree.map(lambda leaf: leaf[rows], wanted)


@partial(jax.jit, static_argnames="grasper")
def _plans(grasper: Grasper, library: Library, own: Wanted) -> Ways | None:
    def of(one: Wanted) -> Ways | None:
        return grasper.plan(library, one.known, one.seen, one.q, one.key, one.tried)

    if len(own.q) == 1:  # as of one world: what a batch computes in vain is not computed
        alone = of(jax.tree.map(lambda leaf: leaf[0], own))
        return jax.tree.map(lambda leaf: leaf[None], alone)
    return jax.vmap(of)(own)


@partial(jax.jit, static_argnames="grasper")
def with_plans(
    grasper: Grasper, state: GraspState, ways: Ways, rows: Int[Array, " part"]
) -> GraspState:
    """All worlds, some of them with new plans.

    Args:
        grasper: The controller.
        state: Of all worlds, stacked.
        ways: Of these worlds, from `planned_in_parts`.
        rows: The worlds; one behind the last stands for none.
    """
    last = len(state.phase) - 1
    some = jax.tree.map(lambda leaf: leaf[jnp.minimum(rows, last)], state)
    new = jax.vmap(grasper.adopt)(some, ways)
    return jax.tree.map(lambda old, row: old.at[rows].set(row, mode="drop"), state, new)
