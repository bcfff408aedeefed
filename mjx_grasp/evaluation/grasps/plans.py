"""New plans for some worlds of many, by one compiled function."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import Known, Seen, Tried, Ways
from mjx_grasp.posture.library import Library


def planned(
    grasper: Grasper,
    library: Library | None,
    known: Known,
    seen: Seen,
    q: Float[Array, "w n"],
    tried: Tried,
    key: Array,
    rows: Int[np.ndarray, " k"],
) -> Ways | None:
    """Plans of some worlds, one at a time; None where the controller makes none.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        known: Of each world's object.
        seen: What each perceives.
        q: Measured joint positions [rad].
        tried: In each world, see `Grasper.plan`.
        key: Of what is tried at random.
        rows: The worlds.
    """
    if library is None:
        return None
    given = known, seen, q, tried
    found = [_plan(grasper, library, given, key, jnp.int32(row)) for row in rows]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


@partial(jax.jit, static_argnames="grasper")
def _plan(
    grasper: Grasper,
    library: Library,
    given: tuple[Known, Seen, Float[Array, "w n"], Tried],
    key: Array,
    row: Int[Array, ""],
) -> Ways | None:
    known, seen, q, tried = jax.tree.map(lambda leaf: leaf[row], given)
    return grasper.plan(library, known, seen, q, jax.random.fold_in(key, row), tried)
