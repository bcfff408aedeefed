"""Mesh queries through NVIDIA Warp's hierarchies and grids, on CPUs and CUDA GPUs, from JAX.

They name faces and sum over them; where on a face a contact lies is computed by the same code for
both backends (:mod:`.rays`, :mod:`.closest`), so that these agree to rounding. Several meshes at
once: a query names its mesh, and faces are counted through all of them.

A query runs in the thread that calls it, on a CPU on one core: call for parts of the work from
:func:`.in_threads`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import warp as wp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry import bvh_kernels, face_blocks_kernel
from mjx_grasp.geometry.face_blocks import WIDTH, FaceBlocks, face_blocks
from mjx_grasp.geometry.rays import EDGE_SLACK
from mjx_grasp.geometry.warp_device import device, launch, load, once, put, start

# Centroids in a leaf of their tree: fewer are found no faster, and take longer to build.
_CENTROIDS_PER_LEAF = 8
# Cells along each side of a grid of centroids; it repeats beyond.
_GRID = 32


class MeshTrees:
    """Hierarchies over the faces of some meshes.

    On a CPU they are built in other threads meanwhile: the first query waits for them.

    Args:
        points: Vertices of each mesh, float32, [m].
        faces: Their indices, counted within each mesh.
    """

    def __init__(
        self,
        points: Sequence[Float[np.ndarray, "_ 3"]],
        faces: Sequence[Int[np.ndarray, "_ 3"]],
    ):
        load(bvh_kernels)
        if device().is_cpu:
            load(face_blocks_kernel)
        # For nearest faces a CPU has a search of its own.
        near: Callable[..., Any] = face_blocks if device().is_cpu else _mesh
        widened = [start(_widened, p, f) for p, f in zip(points, faces, strict=True)]
        built = [start(near, p, f) for p, f in zip(points, faces, strict=True)]
        counts = self.counts = [len(f) for f in faces]
        self._widened = once(lambda: _with_ids([mesh() for mesh in widened]))
        self._meshes = once(lambda: _with_ids([mesh() for mesh in built]))
        self._blocks = once(lambda: _blocks([blocks() for blocks in built], counts))
        diagonals = [np.linalg.norm(np.ptp(p, axis=0)) for p in points]
        self.first_face = put(_starts(self.counts), wp.int32)
        self.diagonal = put(np.asarray(diagonals, np.float32), wp.float32)

    def farthest_faces(
        self,
        owner: Int[Array, " n"],
        origins: Float[Array, "n 3"],
        directions: Float[Array, "n 3"],
    ) -> Int[Array, " n"]:
        """The face that each ray meets farthest from its origin; −1 if none.

        Args:
            owner: Which mesh each ray is for.
            origins: Ray origins in [m], within the mesh's bounding box.
            directions: Ray directions, unit.
        """
        out = wp.empty(len(owner), dtype=wp.int32, device=device())
        inputs = [self._widened()[1], self.first_face, self.diagonal]
        inputs += [*map(_take, (owner, origins, directions)), out]
        launch(bvh_kernels.farthest, len(owner), inputs)
        return wp.to_jax(out)

    def nearest_faces(
        self,
        owner: Int[Array, " n"],
        points: Float[Array, "ksn 3"],
        near: Int[Array, " n"],
        sides: int,
        count: int,
    ) -> Int[Array, " ksn"]:
        """The face nearest to each point; on a GPU −1 if the mesh has none with an area.

        Args:
            owner: Which mesh each of n columns is for.
            points: Queries ``[k, s, n]`` in a row, [m]; the k of a column are near each other, and
                speed each other's search.
            near: A face not far from each column, −1 where none is known.
            sides: s.
            count: Of the n how many are asked; the rest, padding, has no meaning.
        """
        length = len(points) // (sides * len(owner))
        out = wp.empty(len(points), dtype=wp.int32, device=device())
        asked = [*map(_take, (owner, points, near)), sides, len(owner), length, out]
        if device().is_cpu:
            launch(face_blocks_kernel.nearest, (sides, count), [*self._blocks(), *asked])
        else:
            trees = [self._meshes()[1], self.first_face, self.diagonal]
            launch(bvh_kernels.nearest, (sides, count), [*trees, *asked])
        return wp.to_jax(out)


class FaceGrids:
    """The faces of some meshes by the place of their centroids.

    Args:
        trees: Of the meshes.
        centroids: ``[f, 3]`` of all meshes, [m]; more at the end are padding.
        face_normals: ``[f, 3]`` unit.
        areas: ``[f]`` in [m²]; faces without area take no part.
        radius: Faces with their centroid within this of a point count, [m].
        min_faces: If fewer do, the nearest this many.
    """

    def __init__(
        self,
        trees: MeshTrees,
        centroids: Float[Array, "f 3"],
        face_normals: Float[Array, "f 3"],
        areas: Float[Array, " f"],
        *,
        radius: float,
        min_faces: int,
    ):
        self._of = trees
        self._faces = [*map(_take, (centroids, face_normals, areas))]
        ends = itertools.accumulate(trees.counts)
        own = [self._faces[0][e - n : e] for e, n in zip(ends, trees.counts, strict=True)]
        self._radius, self._min_faces = float(radius), int(min_faces)
        self._grids, self._grid_ids = _with_ids([_grid(x, self._radius) for x in own])
        # For what lies far from any faces; few meshes need them.
        self._trees = once(
            lambda: _with_ids([wp.Bvh(x, x, leaf_size=_CENTROIDS_PER_LEAF) for x in own])
        )

    def normal_spread(
        self,
        owner: Int[Array, " n"],
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        tangents: tuple[Float[Array, "n 3"], Float[Array, "n 3"]],
        count: int,
    ) -> Float[Array, "n 3"]:
        """See :func:`mjx_grasp.geometry.curvature.normal_spread`.

        Args:
            owner: Which mesh each point is on.
            points: Surface points in [m].
            normals: Unit normals there.
            tangents: Their tangent bases.
            count: Points that are asked; the rest, padding, has no meaning.
        """
        asked = [*map(_take, (owner, points, normals, *tangents)), *self._faces]
        found = wp.empty(len(owner), dtype=wp.int32, device=device())
        out = wp.empty(len(owner), dtype=wp.vec3, device=device())
        inputs = [self._grid_ids, self._of.first_face, *asked, self._radius, found, out]
        launch(bvh_kernels.spread, count, inputs)
        few = np.flatnonzero(found.numpy()[:count] < self._min_faces).astype(np.int32)
        if len(few):
            inputs = [put(few, wp.int32), self._trees()[1], self._of.first_face, self._of.diagonal]
            inputs += [*asked, self._radius, self._min_faces, out]
            launch(bvh_kernels.wider_spread, len(few), inputs)
        return wp.to_jax(out)


def _mesh(points: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    return wp.Mesh(put(points, wp.vec3), put(faces.astype(np.int32).ravel(), wp.int32))


def _widened(points: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    """The faces for rays, each by itself, and each as much wider as :mod:`.rays` has slack.

    Weights of no less than −s are a face that is 1 + 3 s times as large about its centroid. By half
    of the slack, so that :func:`.rays.hit_on_face` meets whatever is met here.
    """
    corners = points[faces]
    centroids = corners.mean(axis=1, keepdims=True)
    wider = corners + np.float32(1.5 * EDGE_SLACK) * (corners - centroids)
    return _mesh(wider.reshape(-1, 3), np.arange(faces.size))


def _grid(centroids: wp.array, radius: float) -> wp.HashGrid:
    grid = wp.HashGrid(_GRID, _GRID, _GRID, device=device())
    grid.build(centroids, radius)
    return grid


def _starts(counts: Sequence[int]) -> np.ndarray:
    return np.cumsum([0, *counts[:-1]], dtype=np.int32)


def _with_ids(items: list[Any]) -> tuple[list[Any], wp.array]:
    """The items, which live as long as they are held, and what kernels know them by."""
    return items, put(np.array([item.id for item in items], np.uint64), wp.uint64)


def _blocks(found: Sequence[FaceBlocks], counts: Sequence[int]) -> list[wp.array]:
    slots = _starts([len(x.face) for x in found])
    face_of_slot = np.concatenate(
        [x.face + first for x, first in zip(found, _starts(counts), strict=True)]
    )
    slot_of_face = np.empty(sum(counts), np.int32)
    slot_of_face[face_of_slot] = np.arange(len(face_of_slot))
    integers = [_starts([len(x.first) for x in found]), slots // WIDTH]
    return [
        *(put(x, wp.int32) for x in integers),
        put(np.concatenate([x.boxes for x in found]).ravel(), wp.float32),
        put(np.concatenate([x.first for x in found]), wp.int32),
        put(np.concatenate([x.blocks for x in found]).ravel(), wp.float32),
        put(face_of_slot.astype(np.int32), wp.int32),
        put(slot_of_face, wp.int32),
    ]


def _take(array: Array) -> wp.array:
    """An array of JAX as one of Warp, without a copy."""
    array = jax.block_until_ready(array)
    return wp.from_jax(array, dtype=wp.vec3 if array.ndim == 2 else None)
