"""Many small arrays between host and device as one: each transfer costs more than its bytes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32


@dataclass(frozen=True)
class Layout:
    """How the arrays of a tree lie in a row of words of 32 bits; static under jit."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[np.dtype, ...]

    @classmethod
    def of(cls, tree: Any) -> Layout:
        """The layout of a tree of arrays, or of their shapes and dtypes."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(
            structure, tuple(x.shape for x in leaves), tuple(np.dtype(x.dtype) for x in leaves)
        )

    @property
    def size(self) -> int:
        """Words."""
        return sum(math.prod(shape) for shape in self.shapes)

    @property
    def structs(self) -> Any:
        """The tree with shapes and dtypes in the place of arrays."""
        kinds = zip(self.shapes, self.dtypes, strict=True)
        return jax.tree.unflatten(self.tree, [jax.ShapeDtypeStruct(*kind) for kind in kinds])

    def leaves(self, words: Any) -> list[Any]:
        """The words of each array, in its shape."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        starts = [0, *ends[:-1]]
        return [
            words[a:b].reshape(shape) for a, b, shape in zip(starts, ends, self.shapes, strict=True)
        ]


def pack(tree: Any) -> UInt32[np.ndarray, " n"]:
    """A tree of NumPy arrays of float32, int32 or bool, as words."""
    words = (_wide(np.asarray(x)) for x in jax.tree.leaves(tree))
    return np.concatenate([x.reshape(-1).view(np.uint32) for x in words])


def unpack(words: UInt32[np.ndarray, " n"], layout: Layout) -> Any:
    """A tree of NumPy arrays from its words; those of 32 bits are views."""
    return jax.tree.unflatten(
        layout.tree,
        [
            x != 0 if dtype.kind == "b" else x.view(dtype)
            for x, dtype in zip(layout.leaves(words), layout.dtypes, strict=True)
        ],
    )


def pack_on_device(tree: Any) -> UInt32[Array, " n"]:
    """:func:`pack` of arrays of JAX, for use under jit."""
    return jnp.concatenate(
        [jax.lax.bitcast_convert_type(_wide(x), jnp.uint32).ravel() for x in jax.tree.leaves(tree)]
    )


def unpack_on_device(words: UInt32[Array, " n"], layout: Layout) -> Any:
    """:func:`unpack` to arrays of JAX, for use under jit."""
    return jax.tree.unflatten(
        layout.tree,
        [
            x != 0 if dtype.kind == "b" else jax.lax.bitcast_convert_type(x, dtype)
            for x, dtype in zip(layout.leaves(words), layout.dtypes, strict=True)
        ],
    )


def _wide(array: Any) -> Any:
    return array.astype(np.int32) if array.dtype.kind == "b" else array
