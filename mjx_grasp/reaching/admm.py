"""The iterations of ADMM, of one problem or of many, on a processor or a GPU.

Of the two things that every iteration does, products with two small matrices and a projection, a
GPU spends nearly all its time reading the matrices: as XLA's kernels, one product each, they come
from memory at every iteration. There one kernel of Pallas takes a problem's matrices into registers
and does all iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

_WARPS = 8  # that share a problem: 32 registers of each thread for either matrix


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
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
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
    return _loop(splitting, copy, dual, relaxation, count, jnp.matmul)


def in_one_kernel(
    splitting: Splitting,
    copy: Float[Array, " N"],
    dual: Float[Array, " N"],
    relaxation: float,
    count: int,
    interpret: bool = False,
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """:func:`iterated` as one kernel of a GPU.

    Args:
        splitting: The problem.
        copy: To start from.
        dual: Its multipliers.
        relaxation: α, of over-relaxation [-].
        count: Iterations.
        interpret: Without a GPU, slowly.
    """

    def kernel(*refs: Any) -> None:
        *given, copy_out, dual_out = refs
        *problem, copy, dual = (ref[...] for ref in given)
        done = _loop(Splitting(*problem), copy, dual, relaxation, count, _product)
        copy_out[...], dual_out[...] = done

    size = len(copy)
    # Triton knows arrays whose sides are powers of two. What fills them up stays zero.
    arrays = [_filled_up(array) for array in (*splitting, copy, dual)]
    shape = jax.ShapeDtypeStruct(arrays[-1].shape, copy.dtype)
    new = pl.pallas_call(
        kernel,
        out_shape=(shape, shape),
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=_WARPS),
        name="admm",
    )(*arrays)
    return new[0][:size], new[1][:size]


def _loop(
    splitting: Splitting,
    copy: Float[Array, " N"],
    dual: Float[Array, " N"],
    relaxation: float,
    count: int,
    product: Callable[[Array, Array], Array],
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    there, back, begin, least, most = splitting

    def iterate(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        copy, dual = state
        found = begin + product(back, product(there, copy - dual))
        mixed = relaxation * found + (1.0 - relaxation) * copy
        new = jnp.clip(mixed + dual, least, most)
        return new, dual + mixed - new

    return jax.lax.fori_loop(0, count, iterate, (copy, dual))


def _product(matrix: Float[Array, "a b"], vector: Float[Array, " b"]) -> Float[Array, " a"]:
    """As Triton knows it: its own products are of matrices alone."""
    return jnp.sum(matrix * vector[None], axis=1)


def _filled_up(array: Array) -> Array:
    """With zeros, to powers of two."""
    return jnp.pad(array, [(0, pl.next_power_of_2(size) - size) for size in array.shape])
