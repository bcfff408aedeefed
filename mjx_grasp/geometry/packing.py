"""Arrays as few transfers and compilations are to see them: in one piece, and of few sizes.

Each transfer between host and device costs more than its bytes, and each new size a compilation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, UInt32

# Rows are filled up to multiples of at least this.
_LEAST_STEP = 512


def filled_size(rows: int) -> int:
    """To how many rows arrays are filled up, so that those of similar sizes share a compilation.

    A multiple of 512 or, if that is more, of the largest power of two within an eighth of the size.
    """
    step = max(_LEAST_STEP, 2 ** max(0, rows.bit_length() - 4))
    return -(-rows // step) * step


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


def unpack_on_device(words: UInt32[Array, " n"], layout: Layout) -> Any:
    """The tree from its words, as arrays of JAX; for use under jit."""
    return jax.tree.unflatten(
        layout.tree,
        [
            x != 0 if dtype.kind == "b" else jax.lax.bitcast_convert_type(x, dtype)
            for x, dtype in zip(layout.leaves(words), layout.dtypes, strict=True)
        ],
    )


def _wide(array: Any) -> Any:
    return array.astype(np.int32) if array.dtype.kind == "b" else array
