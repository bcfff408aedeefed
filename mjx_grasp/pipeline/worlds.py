"""Of many worlds, those that need something get it, and the others cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

Tree = TypeVar("Tree")

# A batch is worked through in parts of this share of all worlds: where few need something, one part
# does.
_SHARE = 1 / 16
# A GPU, for which a part takes little less time than all worlds, does more than this share at once.
_MANY = 1 / 4


def for_those(
    need: Bool[Array, " w"], compute: Callable[[Int[Array, ""]], Tree], otherwise: Tree
) -> Tree:
    """What is computed for the worlds that need it, and what the others have.

    Args:
        need: Which worlds do.
        compute: From a world's number to what it gets, of one world.
        otherwise: What the others keep, of all worlds.
    """
    if jax.default_backend() == "cpu":
        return _in_parts(need, compute, otherwise)
    return jax.lax.cond(
        jnp.sum(need) > _MANY * len(need),
        lambda: _at_once(need, compute, otherwise),
        lambda: _in_parts(need, compute, otherwise),
    )


def _at_once(
    need: Bool[Array, " w"], compute: Callable[[Int[Array, ""]], Tree], otherwise: Tree
) -> Tree:
    found = jax.vmap(compute)(jnp.arange(len(need)))

    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(need.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(chosen, found, otherwise)


def _in_parts(
    need: Bool[Array, " w"], compute: Callable[[Int[Array, ""]], Tree], otherwise: Tree
) -> Tree:
    worlds = len(need)
    part = max(1, round(_SHARE * worlds))
    rows = jnp.nonzero(need, size=-(-worlds // part) * part, fill_value=worlds)[0]
    count = jnp.sum(need)

    def is_more(carry: tuple[Array, Tree]) -> Array:
        return carry[0] < count

    def next_part(carry: tuple[Array, Tree]) -> tuple[Array, Tree]:
        done, all_worlds = carry
        some = jax.lax.dynamic_slice(rows, (done,), (part,))
        found = jax.vmap(compute)(jnp.minimum(some, worlds - 1))
        # Rows beyond the last world fill the last part up: they are dropped.
        put = jax.tree.map(lambda old, new: old.at[some].set(new, mode="drop"), all_worlds, found)
        return done + part, put

    return jax.lax.while_loop(is_more, next_part, (jnp.int32(0), otherwise))[1]
