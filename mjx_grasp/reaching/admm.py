"""The iterations of ADMM, of one problem or of many, on a processor or a GPU.

Of the two things that every iteration does, products with two small matrices and a projection, a
GPU spends nearly all its time reading the matrices: as XLA's kernels, one product each, they come
from memory at every iteration. There one kernel of Pallas takes a problem's matrices into registers
and does all iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

_WARPS = 4  # that share a problem; two or eight take about as long, one far longer

CopyAndDual = tuple[Float[Array, " _"], Float[Array, " _"]]


class Splitting(NamedTuple):
    """What the iterations of one problem need; N numbers are kept within bounds, of n variables."""

    there: Float[Array, "n N"]
    """times them: the right-hand side"""
    back: Float[Array, "N n"]
    """times the right-hand side: them again"""
    begin: Float[Array, " N"]
    """what the linear term adds to them"""
    least: Float[Array, " N"]
    """bounds, from here"""
    most: Float[Array, " N"]
    """to here"""


def iterated(
    splitting: Splitting,
    copy: Float[Array, " N"],
    dual: Float[Array, " N"],
    relaxation: float,
    count: int,
) -> CopyAndDual:
    """The copy within the bounds, and its scaled multipliers, after so many iterations.

    Args:
        splitting: The problem.
        copy: To start from.
        dual: Its multipliers.
        relaxation: α, of over-relaxation [-].
        count: Iterations.
    """
    if jax.default_backend() == "gpu":
        return in_one_kernel(splitting, copy, dual, relaxation, count)
    ((copy, dual),) = _loop([splitting], [(copy, dual)], relaxation, count, jnp.matmul)
    return copy, dual


def in_one_kernel(
    splitting: Splitting,
    copy: Float[Array, " N"],
    dual: Float[Array, " N"],
    relaxation: float,
    count: int,
    interpret: bool = False,
) -> CopyAndDual:
    """:func:`iterated` as one kernel of a GPU.

    Args:
        splitting: The problem.
        copy: To start from.
        dual: Its multipliers.
        relaxation: α, of over-relaxation [-].
        count: Iterations.
        interpret: Without a GPU, slowly.
    """
    parts, starts = _cut(splitting, copy, dual)

    def kernel(*refs: Any) -> None:
        parts, starts = jax.tree.map(lambda ref: ref[...], refs[:2])
        found = _loop(parts, starts, relaxation, count, _product)
        for (copy, dual), new in zip(refs[2:], found, strict=True):
            copy[...], dual[...] = new

    found = pl.pallas_call(
        kernel,
        out_shape=jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), starts),
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=_WARPS),
        name="admm",
    )(parts, starts)
    copies, duals = zip(*found, strict=True)
    return jnp.concatenate(copies)[: len(copy)], jnp.concatenate(duals)[: len(dual)]


def _loop(
    parts: list[Splitting],
    starts: list[CopyAndDual],
    relaxation: float,
    count: int,
    product: Callable[[Array, Array], Array],
) -> list[CopyAndDual]:
    """The iterations; the bounded numbers may be in several parts."""

    def iterate(_: Array, state: list[CopyAndDual]) -> list[CopyAndDual]:
        shares = [product(part.there, c - d) for part, (c, d) in zip(parts, state, strict=True)]
        rhs = reduce(jnp.add, shares)

        def moved(part: Splitting, copy: Array, dual: Array) -> CopyAndDual:
            found = part.begin + product(part.back, rhs)
            mixed = relaxation * found + (1.0 - relaxation) * copy
            new = jnp.clip(mixed + dual, part.least, part.most)
            return new, dual + mixed - new

        return [moved(part, *of) for part, of in zip(parts, state, strict=True)]

    return jax.lax.fori_loop(0, count, iterate, starts)


def _product(matrix: Float[Array, "a b"], vector: Float[Array, " b"]) -> Float[Array, " a"]:
    """As Triton knows it: its own products are of matrices alone."""
    return jnp.sum(matrix * vector[None], axis=1)


def _cut(
    splitting: Splitting, copy: Float[Array, " N"], dual: Float[Array, " N"]
) -> tuple[list[Splitting], list[CopyAndDual]]:
    """Arrays whose sides are powers of two, as Triton wants them; what fills them up stays zero.

    Cut where a power of two ends, if what is left needs less filling up than the whole does.
    """
    size = len(copy)
    at = pl.next_power_of_2(size) // 2
    ends = [0, size] if 2 * (size - at) > at else [0, at, size]

    def pieces(array: Array, axis: int = 0) -> list[Array]:
        cuts = [jax.lax.slice_in_dim(array, *ab, axis=axis) for ab in pairwise(ends)]
        return [
            jnp.pad(cut, [(0, pl.next_power_of_2(side) - side) for side in cut.shape])
            for cut in cuts
        ]

    there, back, *rest = splitting
    parts = zip(pieces(there, axis=1), pieces(back), *map(pieces, rest), strict=True)
    return [Splitting(*part) for part in parts], [*zip(pieces(copy), pieces(dual), strict=True)]
