"""Mesh queries through bounding-volume hierarchies: NVIDIA Warp's, on CPUs and CUDA GPUs.

They name faces and sum over them; where on a face a contact lies is computed by the same code for
both backends (:mod:`.rays`, :mod:`.closest`), so that these agree to rounding. Several meshes at
once: a query names its mesh, and faces are counted through all of them.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
import warp as wp
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry import bvh_kernels
from mjx_grasp.geometry.curvature import tangent_basis

# Launches per CPU core: enough that cores end at about the same time.
_PARTS_PER_CORE = 2
_LEAST_PART = 256
# Centroids in a leaf of their tree: fewer are found no faster, and take longer to build.
_CENTROIDS_PER_LEAF = 8


class MeshTrees:
    """Hierarchies over the faces of some meshes and over their centroids, for queries from JAX.

    Args:
        points: Vertices of each mesh, float32, [m].
        faces: Their indices, counted within each mesh.
        centroids: Face centroids of each mesh, float32, [m].
    """

    def __init__(
        self,
        points: Sequence[Float[np.ndarray, "v 3"]],
        faces: Sequence[Int[np.ndarray, "f 3"]],
        centroids: Sequence[Float[np.ndarray, "f 3"]],
    ):
        self._device = _device()
        run = _pool().map if self._device.is_cpu else map
        # Built beside the meshes: first asked for when the rays are done.
        trees = run(self._tree, centroids)
        self._meshes = list(run(self._mesh, points, faces))
        self._trees = list(trees)
        counts = [len(f) for f in faces]
        diagonals = [np.linalg.norm(np.ptp(p, axis=0)) for p in points]
        self._first_face = self._put(np.cumsum([0, *counts[:-1]]).astype(np.int32), wp.int32)
        self._diagonal = self._put(np.asarray(diagonals, np.float32), wp.float32)
        self._mesh_ids = self._ids(self._meshes)
        self._tree_ids = self._ids(self._trees)

    def _mesh(self, points: np.ndarray, faces: np.ndarray) -> wp.Mesh:
        corners = self._put(faces.astype(np.int32).ravel(), wp.int32)
        return wp.Mesh(self._put(points, wp.vec3), corners)

    def _tree(self, centroids: np.ndarray) -> wp.Bvh:
        at = self._put(centroids, wp.vec3)
        return wp.Bvh(at, at, leaf_size=_CENTROIDS_PER_LEAF)

    def farthest_faces(
        self,
        owner: Int[Array, " n"],
        origins: Float[Array, "n 3"],
        directions: Float[Array, "n 3"],
        count: int,
    ) -> Int[Array, " n"]:
        """The face that each ray meets farthest from its origin; −1 if none.

        Args:
            owner: Which mesh each ray is for.
            origins: Ray origins in [m], within the mesh's bounding box.
            directions: Ray directions, unit.
            count: Rays that are asked; the rest is padding.
        """
        out = wp.full(len(owner), -1, dtype=wp.int32, device=self._device)
        inputs = [self._mesh_ids, self._first_face, self._diagonal]
        inputs += [*map(self._take, (owner, origins, directions)), out]
        self._launch(bvh_kernels.farthest, count, inputs)
        return wp.to_jax(out)

    def nearest_faces(
        self,
        owner: Int[Array, " n"],
        points: Float[Array, "k n 3"],
        bound: Float[Array, "k n"],
    ) -> Int[Array, "k n"]:
        """The face nearest to each point; −1 if the mesh has none with an area.

        Args:
            owner: Which mesh each column of points is for.
            points: Queries in [m]; those of a column are near each other, and speed each other's
                search.
            bound: Somewhat more than a distance within which there is a face, [m].
        """
        length, chains = bound.shape
        flat = points.reshape(-1, 3), bound.reshape(-1)
        out = wp.full(length * chains, -1, dtype=wp.int32, device=self._device)
        inputs: list[Any] = [self._mesh_ids, self._first_face, self._diagonal]
        inputs += [self._take(owner), *map(self._take, flat), chains, length, out]
        self._launch(bvh_kernels.nearest, chains, inputs)
        return wp.to_jax(out).reshape(length, chains)

    def normal_spread(
        self,
        owner: Int[Array, " n"],
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        centroids: Float[Array, "f 3"],
        face_normals: Float[Array, "f 3"],
        face_areas: Float[Array, " f"],
        *,
        radius: float,
        min_faces: int,
        count: int,
    ) -> Float[Array, "n 3"]:
        """See :func:`mjx_grasp.geometry.curvature.normal_spread`; faces are those of all meshes."""
        arguments = (owner, points, normals, *_tangents(normals))
        arguments += (centroids, face_normals, face_areas)
        inputs = [self._tree_ids, self._first_face, self._diagonal, *map(self._take, arguments)]
        out = wp.zeros(len(owner), dtype=wp.vec3, device=self._device)
        self._launch(bvh_kernels.spread, count, [*inputs, float(radius), int(min_faces), out])
        return wp.to_jax(out)

    def _launch(self, kernel: Any, count: int, inputs: list[Any]) -> None:
        """Runs a kernel; on a CPU, where Warp uses one core, in parts on all of them."""

        def part(start: int, size: int) -> None:
            wp.launch(kernel, dim=size, inputs=[start, *inputs], device=self._device)

        if not self._device.is_cpu:
            part(0, count)
            # JAX does not know of Warp's stream.
            wp.synchronize_device(self._device)
            return
        size = max(_LEAST_PART, -(-count // (_PARTS_PER_CORE * _cores())))
        starts = range(0, count, size)
        list(_pool().map(lambda start: part(start, min(size, count - start)), starts))

    def _put(self, array: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=self._device)

    def _ids(self, items: Sequence[Any]) -> wp.array:
        return self._put(np.array([item.id for item in items], np.uint64), wp.uint64)

    def _take(self, array: Array) -> wp.array:
        """An array of JAX as one of Warp, without a copy."""
        array = jax.block_until_ready(array)
        return wp.from_jax(array, dtype=wp.vec3 if array.ndim == 2 else None)


_tangents = jax.jit(tangent_basis)


def _cores() -> int:
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Threads that stay: to start them takes as long as a query of a whole mesh."""
    return ThreadPoolExecutor(_cores())


def _device() -> Any:
    """Warp's name for JAX's device; the first call starts Warp and loads the kernels, quietly."""
    level = wp.config.log_level
    try:
        wp.config.log_level = wp.LOG_ERROR
        wp.init()
        device = wp.device_from_jax(jax.devices()[0])
        wp.load_module(bvh_kernels, device=device)
    finally:
        wp.config.log_level = level
    return device
