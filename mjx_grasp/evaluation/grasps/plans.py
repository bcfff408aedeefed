"""New plans for some worlds of many, in one compiled size."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import Known, Seen, Ways
from mjx_grasp.posture.library import Library

_AT_ONCE = 8


def planned(
    grasper: Grasper,
    library: Library | None,
    known: Known,
    seen: Seen,
    q: Float[Array, "w n"],
    avoid: Float[Array, "w 3"],
    key: Array,
    rows: Int[np.ndarray, " k"],
) -> Ways | None:
    """Plans of some worlds, a few at a time; None where the controller makes none.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        known: Of each world's object.
        seen: What each perceives.
        q: Measured joint positions [rad].
        avoid: See `Grasper.plan`.
        key: Of what is tried at random.
        rows: The worlds.
    """
    if library is None:
        return None
    parts, size = [], min(_AT_ONCE, len(q))
    for first in range(0, len(rows), size):
        some = rows[np.minimum(np.arange(first, first + size), len(rows) - 1)]
        keys = jax.vmap(lambda row: jax.random.fold_in(key, row))(jnp.asarray(some))
        given = jax.tree.map(lambda leaf, some=some: leaf[some], (known, seen, q, avoid))
        part = _plan(grasper, library, *given, keys)
        kept = min(size, len(rows) - first)
        parts.append(jax.tree.map(lambda leaf, kept=kept: leaf[:kept], part))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@partial(jax.jit, static_argnames="grasper")
def _plan(
    grasper: Grasper,
    library: Library,
    known: Known,
    seen: Seen,
    q: Float[Array, "k n"],
    avoid: Float[Array, "k 3"],
    keys: Array,
) -> Ways | None:
    def one(given: tuple[Known, Seen, Array, Array, Array]) -> Ways | None:
        known, seen, q, avoid, key = given
        return grasper.plan(library, known, seen, q, key, avoid)

    return jax.lax.map(one, (known, seen, q, avoid, keys))
