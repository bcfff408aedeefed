"""Work on all pairs of queries and faces, in tiles of bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# Bytes of one matrix of queries times faces: on a CPU it stays in the cache; a GPU is filled.
_CPU_BYTES = 4 * 2**20
_GPU_BYTES = 512 * 2**20
_LEAST_TILE = 16

T = TypeVar("T")


def tile_for(faces: int, batch: int = 1) -> int:
    """Queries to work on at once on this device, for meshes of so many faces.

    Args:
        faces: Faces of a mesh.
        batch: Meshes worked on at once.
    """
    budget = _CPU_BYTES if jax.default_backend() == "cpu" else _GPU_BYTES
    return max(_LEAST_TILE, budget // (4 * max(faces, 1) * batch))


def map_tiles(function: Callable[..., T], rows: Any, tile: int) -> T:
    """``function`` over tiles of rows, which it takes and gives ``[tile, …]`` at once.

    Args:
        function: From arrays with up to ``tile`` rows to arrays with as many.
        rows: Arrays ``[n, …]``.
        tile: Most rows of one call.
    """
    n = jax.tree.leaves(rows)[0].shape[0]
    count = math.ceil(n / tile)
    if count <= 1:
        return function(*rows)
    size = math.ceil(n / count)

    def cut(x: Array) -> Array:
        # Rows that fill the last tile repeat the first one: any value that is safe to work on.
        filled = jnp.concatenate([x, jnp.broadcast_to(x[:1], (size * count - n, *x.shape[1:]))])
        return filled.reshape(count, size, *x.shape[1:])

    result = jax.lax.map(lambda args: function(*args), jax.tree.map(cut, rows))
    return jax.tree.map(lambda x: x.reshape(size * count, *x.shape[2:])[:n], result)


def first_least(values: Float[Array, "n f"]) -> Int[Array, " n"]:
    """Index of the first of the least values of each row.

    On a GPU it fuses with what gives the values, and no matrix is ever written. Compilers for CPUs
    do not vectorise an argmin: there it takes two passes that they do (7 times faster).
    """
    if jax.default_backend() != "cpu":
        return jnp.argmin(values, axis=1).astype(jnp.int32)
    # Kept as they are: both passes read them, and neither shall compute them again.
    values = jax.lax.optimization_barrier(values)
    index = jnp.arange(values.shape[1], dtype=jnp.int32)
    least = values <= jnp.min(values, axis=1, keepdims=True)
    return jnp.min(jnp.where(least, index, values.shape[1]), axis=1)
