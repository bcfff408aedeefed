"""Of many worlds, those that need something get it, and the others cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

Given = TypeVar("Given")
Tree = TypeVar("Tree")

# A processor works through the worlds in parts of this share of all: where few need something, one
# part does.
_SHARE = 1 / 16
# A GPU computes at once for the least of these shares that holds all who need it: a small part
# takes little less time than a large one, and asking for another means waiting for it.
_SHARES = 1 / 16, 1 / 4
# Each of these parts compiles for itself. Up to so many worlds all of them take little less time.
_FEW = 2048


def for_those(
    need: Bool[Array, " w"],
    compute: Callable[[Given], Tree],
    given: Given,
    otherwise: Tree,
    cheap: bool = False,
) -> Tree:
    """What is computed for the worlds that need it, and what the others have.

    Args:
        need: Which worlds do.
        compute: What a world gets, of what it is given.
        given: To each world, stacked.
        otherwise: What the others keep, of all worlds.
        cheap: Whether a GPU has it computed sooner than it is known who needs it.
    """
    worlds = len(need)
    if jax.default_backend() == "cpu":
        return _in_parts(need, compute, given, otherwise)
    if cheap:
        return _for_all(need, compute, given, otherwise)
    shares = _SHARES if worlds > _FEW else ()
    sizes = sorted({_part(share, worlds) for share in shares} - {worlds})
    ways: list[Callable[[], Tree]] = [
        lambda: otherwise,
        *(partial(_for_some, need, compute, given, otherwise, size) for size in sizes),
        partial(_for_all, need, compute, given, otherwise),
    ]
    return jax.lax.switch(jnp.sum(jnp.sum(need) > np.array([0, *sizes])), ways)


def _part(share: float, worlds: int) -> int:
    return max(1, round(share * worlds))


def _for_all(
    need: Bool[Array, " w"], compute: Callable[[Given], Tree], given: Given, otherwise: Tree
) -> Tree:
    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(need.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(chosen, jax.vmap(compute)(given), otherwise)


def _for_some(
    need: Bool[Array, " w"],
    compute: Callable[[Given], Tree],
    given: Given,
    otherwise: Tree,
    size: int,
) -> Tree:
    """For all who need it: no more than so many do."""
    rows = jnp.nonzero(need, size=size, fill_value=len(need))[0]
    return _put(rows, compute, given, otherwise)


def _in_parts(
    need: Bool[Array, " w"], compute: Callable[[Given], Tree], given: Given, otherwise: Tree
) -> Tree:
    worlds = len(need)
    part = _part(_SHARE, worlds)
    rows = jnp.nonzero(need, size=-(-worlds // part) * part, fill_value=worlds)[0]
    count = jnp.sum(need)

    def is_more(carry: tuple[Array, Tree]) -> Array:
        return carry[0] < count

    def next_part(carry: tuple[Array, Tree]) -> tuple[Array, Tree]:
        done, all_worlds = carry
        some = jax.lax.dynamic_slice(rows, (done,), (part,))
        return done + part, _put(some, compute, given, all_worlds)

    return jax.lax.while_loop(is_more, next_part, (jnp.int32(0), otherwise))[1]


def _put(
    rows: Int[Array, " r"], compute: Callable[[Given], Tree], given: Given, all_worlds: Tree
) -> Tree:
    """What some worlds get, put among all; rows beyond the last world stand for none."""

    def of_world(row: Int[Array, ""]) -> Tree:
        return compute(jax.tree.map(lambda leaf: leaf[row], given))

    last = jax.tree.leaves(all_worlds)[0].shape[0] - 1
    found = jax.vmap(of_world)(jnp.minimum(rows, last))
    return jax.tree.map(lambda old, new: old.at[rows].set(new, mode="drop"), all_worlds, found)
