"""New plans for some worlds of many, each looked for by itself, on the processor's cores.

A search for one world alone is as fast on a core as one of a batch on a GPU, whose compiler takes
minutes for it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Tried, Ways
from mjx_grasp.posture.library import Library
from mjx_grasp.records.provenance import usable_cores

_ADOPTED = 64
"""Worlds that take over plans at once, so that one compiled function is enough."""


class Wanted(NamedTuple):
    """What is planned for, of all worlds, stacked."""

    known: Known
    """of NumPy, or it is fetched from the device each time"""
    seen: Seen
    q: Float[Array, "w n"]
    """measured joint positions [rad]"""
    tried: Tried
    """see `Grasper.plan`"""


def processor() -> jax.Device:
    """JAX's device of this machine's cores, be there others or not."""
    return jax.local_devices(backend="cpu")[0]


def planned(
    grasper: Grasper,
    library: Library | None,
    wanted: Wanted,
    key: Array,
    rows: Int[np.ndarray, " k"],
) -> Ways | None:
    """Plans of some worlds, of NumPy; None where the controller makes none.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        wanted: What is planned for, in all worlds.
        key: Of what is tried at random.
        rows: The worlds, one at least.
    """
    if library is None:
        return None
    library, key = jax.device_put((library, key), processor())
    wanted = jax.device_get(wanted)

    def of(row: int) -> Ways:
        own = jax.tree.map(lambda leaf: leaf[row], wanted)
        return jax.device_get(_plans(grasper, library, own, key, row))

    found = [of(rows[0])]  # it may have to be compiled, once
    if len(rows) > 1:
        with ThreadPoolExecutor(usable_cores()) as pool:
            found += pool.map(of, rows[1:])
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


@partial(jax.jit, static_argnames="grasper")
def _plans(
    grasper: Grasper, library: Library, own: Wanted, key: Array, row: Int[Array, ""]
) -> Ways | None:
    known, seen, q, tried = own
    return grasper.plan(library, known, seen, q, jax.random.fold_in(key, row), tried)


def with_plans(
    grasper: Grasper, state: GraspState, ways: Ways, rows: Int[np.ndarray, " k"]
) -> GraspState:
    """All worlds, some of them with new plans.

    Args:
        grasper: The controller.
        state: Of all worlds, stacked.
        ways: Of these worlds, from `planned`.
        rows: The worlds.
    """
    worlds = len(state.phase)
    for first in range(0, len(rows), _ADOPTED):
        part = np.full(_ADOPTED, worlds, np.int32)  # one behind the last stands for none
        some = rows[first : first + _ADOPTED]
        part[: len(some)] = some
        own = np.minimum(first + np.arange(_ADOPTED), len(rows) - 1)
        state = _adopted(grasper, state, jax.tree.map(lambda leaf, own=own: leaf[own], ways), part)
    return state


@partial(jax.jit, static_argnames="grasper")
def _adopted(
    grasper: Grasper, state: GraspState, ways: Ways, rows: Int[Array, " part"]
) -> GraspState:
    last = len(state.phase) - 1
    some = jax.tree.map(lambda leaf: leaf[jnp.minimum(rows, last)], state)
    new = jax.vmap(grasper.adopt)(some, ways)
    return jax.tree.map(lambda old, row: old.at[rows].set(row, mode="drop"), state, new)
