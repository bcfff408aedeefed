"""Short loops and sums of a few cheap terms, as suits what computes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

State = TypeVar("State")


def repeated(count: int, step: Callable[[State], State], begin: State) -> State:
    """What becomes of a state in so many steps.

    A processor goes round in a loop, for which there is less to compile; on a GPU, where each round
    would be kernels of its own, the steps are written out.

    Args:
        count: Of steps.
        step: From a state to the next one.
        begin: The state at first.
    """
    return jax.lax.fori_loop(
        0, count, lambda _, state: step(state), begin, unroll=jax.default_backend() != "cpu"
    )


def sum_over(count: int, terms: Callable[[Int[Array, ""]], tuple[Array, ...]]) -> tuple[Array, ...]:
    """The sums over numbers from 0 of what a function makes of each.

    On a GPU all terms are computed at once, as every kernel that is launched takes time. A
    processor makes them one after the other, which needs no room for them; and as a loop is not
    fused with what follows it, none is computed over for each use of the sums.

    Args:
        count: Of numbers.
        terms: Of a number.
    """
    if jax.default_backend() == "cpu":
        terms = jax.jit(terms)  # traced once: for its shapes and for the loop
        begin = tuple(jnp.zeros(t.shape, t.dtype) for t in jax.eval_shape(terms, jnp.int32(0)))

        def add(number: Int[Array, ""], sums: tuple[Array, ...]) -> tuple[Array, ...]:
            return tuple(s + t for s, t in zip(sums, terms(number), strict=True))

        return jax.lax.fori_loop(0, count, add, begin)
    sums = tuple(jnp.sum(term, axis=0) for term in jax.vmap(terms)(jnp.arange(count)))
    return jax.lax.optimization_barrier(sums)
