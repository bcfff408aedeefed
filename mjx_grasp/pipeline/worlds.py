"""Of many worlds, those that need something get it, and the others cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

Given = TypeVar("Given")
Tree = TypeVar("Tree")

# A batch is worked through in parts of this share of all worlds: where few need something, one part
# does.
_SHARE = 1 / 16
# On a GPU a small part takes little less time than a large one. Where up to `_SOME` of all worlds
# need something, the parts are of `_LARGER`; where more do, all worlds are computed at once.
_SOME, _LARGER = 1 / 2, 1 / 4


def for_those(
    need: Bool[Array, " w"], compute: Callable[[Given], Tree], given: Given, otherwise: Tree
) -> Tree:
    """What is computed for the worlds that need it, and what the others have.

    Args:
        need: Which worlds do.
        compute: What a world gets, of what it is given.
        given: To each world, stacked.
        otherwise: What the others keep, of all worlds.
    """
    few, some = (partial(_in_parts, need, compute, given, otherwise, s) for s in (_SHARE, _LARGER))
    if jax.default_backend() == "cpu":
        return few()
    # Without a part it takes none, however large that is.
    above = np.asarray([_SHARE, _SOME]) * len(need)
    kind = jnp.sum(jnp.sum(need) > above)
    return jax.lax.switch(kind, [few, some, partial(_at_once, need, compute, given, otherwise)])


def _at_once(
    need: Bool[Array, " w"], compute: Callable[[Given], Tree], given: Given, otherwise: Tree
) -> Tree:
    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(need.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(chosen, jax.vmap(compute)(given), otherwise)


def _in_parts(
    need: Bool[Array, " w"],
    compute: Callable[[Given], Tree],
    given: Given,
    otherwise: Tree,
    share: float,
) -> Tree:
    worlds = len(need)
    part = max(1, round(share * worlds))
    rows = jnp.nonzero(need, size=-(-worlds // part) * part, fill_value=worlds)[0]
    count = jnp.sum(need)

    def is_more(carry: tuple[Array, Tree]) -> Array:
        return carry[0] < count

    def next_part(carry: tuple[Array, Tree]) -> tuple[Array, Tree]:
        done, all_worlds = carry
        some = jax.lax.dynamic_slice(rows, (done,), (part,))
        taken = jnp.minimum(some, worlds - 1)
        found = jax.vmap(lambda row: compute(jax.tree.map(lambda leaf: leaf[row], given)))(taken)
        # Rows beyond the last world fill the last part up: they are dropped.
        put = jax.tree.map(lambda old, new: old.at[some].set(new, mode="drop"), all_worlds, found)
        return done + part, put

    return jax.lax.while_loop(is_more, next_part, (jnp.int32(0), otherwise))[1]
