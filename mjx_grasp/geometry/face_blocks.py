"""Faces in blocks of eight, in a tree of boxes with eight children: what one CPU core searches at
once.

A CPU compares a point with eight boxes, or with eight triangles, in the time of one. NVIDIA Warp's
own hierarchies have two children, and its compiler for CPUs does not vectorise: so on CPUs
:mod:`.bvh` finds nearest faces with these blocks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.geometry.mesh import corner_rows, cross_rows, dot_rows

WIDTH = 8
# Beyond everything, and its square is no number: no point is near the box that is not there.
_NOWHERE = 1e30


class FaceBlocks(NamedTuple):
    """The faces of a mesh; slot ``s`` of theirs is lane ``s % 8`` of block ``s // 8``.

    Attributes:
        blocks: ``[b, 18, 8]`` of each face its corner, edges ``ab`` and ``ac``, the vectors that
            give barycentric weights (``ac × n / |n|²`` and ``n × ab / |n|²``, zero without an
            area), and the inverse squared lengths of ``ab``, ``ac`` and ``bc``; m.
        face: ``[8·b]`` the face in each slot; some are there twice, to fill blocks.
        boxes: ``[n, 6, 8]`` lower and upper corners of each node's children, [m].
        first: ``[n]`` first child of each node: a node, or, in the last level, ``−1 − block``. Node
            0 is the root.
    """

    blocks: Float[np.ndarray, "b 18 8"]
    face: Int[np.ndarray, " slots"]
    boxes: Float[np.ndarray, "n 6 8"]
    first: Int[np.ndarray, " n"]


def face_blocks(points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> FaceBlocks:
    """Groups the faces of a mesh by place: halves along the longest side, and halves of these.

    Args:
        points: Vertices, float32, [m].
        faces: Their indices.
    """
    corners = corner_rows(points, faces)
    face = _grouped(corners[0] + corners[1] + corners[2])
    a, b, c = (corner[:, face] for corner in corners)
    ab, ac, bc = b - a, c - a, c - b
    normal = cross_rows(ab, ac)
    inverse = _inverse(dot_rows(normal, normal))
    lengths = [_inverse(dot_rows(edge, edge))[None] for edge in (ab, ac, bc)]
    duals = cross_rows(ac, normal) * inverse, cross_rows(normal, ab) * inverse
    blocks = _in_lanes(np.concatenate([a, ab, ac, *duals, *lengths]))
    lower, upper = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    boxes, first = _tree(*(_in_lanes(x) for x in (lower, upper)))
    return FaceBlocks(blocks, face.astype(np.int32), boxes, first)


def _grouped(at: Float[np.ndarray, "3 f"]) -> Int[np.ndarray, " slots"]:
    """Indices of points such that each eight in a row are near each other; some more than once."""
    n = at.shape[1]
    halvings = {k: max(0, int(np.ceil(np.log2(n / (WIDTH * k))))) for k in (1, 3, 5, 7)}
    start, depth = min(halvings.items(), key=lambda item: item[0] << item[1])
    index = np.arange(WIDTH * start << depth)
    at = at[:, np.minimum(index, n - 1)]
    lower, upper = at.min(axis=1)[:, None], at.max(axis=1)[:, None]
    for ways in (*(start,) * (start > 1), *depth * (2,)):
        cells = lower.shape[1]
        row = np.arange(cells)
        axis = np.argmax(upper - lower, axis=0)
        key = at.reshape(3, cells, -1)[axis, row]
        size = key.shape[1] // ways
        cuts = size * np.arange(1, ways)
        order = np.argpartition(key, cuts, axis=1)
        # Cells are cut at the first of each part: it is not worth finding how far points reach.
        at_cut = np.take_along_axis(key, order[:, cuts], axis=1)
        lower, upper = (np.repeat(x, ways, axis=1) for x in (lower, upper))
        for k in range(1, ways):
            upper[axis, ways * row + k - 1] = at_cut[:, k - 1]
            lower[axis, ways * row + k] = at_cut[:, k - 1]
        order = (order + key.shape[1] * row[:, None]).ravel()
        index, at = index[order], at[:, order]
    return np.minimum(index, n - 1)


def _tree(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes over the boxes ``[b, 3, 8]`` of the faces in blocks, the root first."""
    levels: list[np.ndarray] = []
    while not levels or len(levels[-1]) > 1:
        lower, upper = lower.min(axis=2).T, upper.max(axis=2).T
        fill = (0, 0), (0, -lower.shape[1] % WIDTH)
        lower = _in_lanes(np.pad(lower, fill, constant_values=_NOWHERE))
        upper = _in_lanes(np.pad(upper, fill, constant_values=-_NOWHERE))
        levels.append(np.concatenate([lower, upper], axis=1))
    ends = np.cumsum([len(level) for level in levels[::-1]])
    children = [WIDTH * np.arange(len(level)) for level in levels[::-1]]
    first = [end + child for end, child in zip(ends[:-1], children[:-1], strict=True)]
    first.append(-1 - children[-1])
    return np.concatenate(levels[::-1]), np.concatenate(first).astype(np.int32)


def _in_lanes(rows: np.ndarray) -> np.ndarray:
    """Rows ``[r, 8·b]`` as ``[b, r, 8]``."""
    return np.ascontiguousarray(rows.reshape(len(rows), -1, WIDTH).swapaxes(0, 1))


def _inverse(squared: np.ndarray) -> np.ndarray:
    """0 where nothing can be told from 0, as on devices that flush subnormal numbers."""
    some = squared >= np.finfo(np.float32).tiny
    return np.where(some, 1 / np.where(some, squared, 1), np.float32(0))
