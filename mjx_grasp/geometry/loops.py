"""Loops of a few cheap steps, as suits what runs them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array

Tree = TypeVar("Tree")

_UNROLLED = 10  # steps in one turn, on a GPU


def short_loop(count: int, step: Callable[[Array, Tree], Tree], begin: Tree) -> Tree:
    """`jax.lax.fori_loop` from 0, unrolled where that is faster.

    On a GPU every turn of a loop is launches of kernels, and copies of what it carries; of several
    steps in one turn XLA makes less. On a processor turns cost nothing, and as a loop is not fused
    with what follows it, nothing is computed over for each use of what comes out.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.fori_loop(0, count, step, begin)
    found = jax.lax.fori_loop(0, count, step, begin, unroll=min(count, _UNROLLED))
    return jax.lax.optimization_barrier(found)
