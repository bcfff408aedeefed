"""Candidates of meshes by hierarchies of their faces, in NVIDIA Warp."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from mjx_grasp.geometry.closest import ClosestPoints, closest_on_face
from mjx_grasp.geometry.curvature import tangent_basis
from mjx_grasp.geometry.packing import Layout, pack, unpack_on_device
from mjx_grasp.geometry.rays import RayHits, hit_on_face
from mjx_grasp.heatmap.backends import long_axes
from mjx_grasp.heatmap.candidates import (
    GraspLimits,
    HeatmapRows,
    Masses,
    Surfaces,
    Thumbs,
    best_candidates,
    opposing_contacts,
    wrap_seeds,
)
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.records.provenance import usable_cores

if TYPE_CHECKING:
    from mjx_grasp.geometry.bvh import MeshTrees


def start_trees(
    points: Sequence[Float[np.ndarray, "_ 3"]], faces: Sequence[Int[np.ndarray, "_ 3"]]
) -> MeshTrees:
    """Hierarchies of meshes, which are built meanwhile.

    Args:
        points: Vertices of each mesh, float32, [m].
        faces: Their indices, counted within each mesh.
    """
    # Warp takes half a second to import, and only this backend needs it.
    from mjx_grasp.geometry.bvh import MeshTrees

    return MeshTrees(points, faces)


def bvh_candidates(
    trees: MeshTrees,
    surfaces: Surfaces,
    masses: Masses,
    counts: Sequence[tuple[int, int]],
    hand: GraspLimits,
    config: HeatmapConfig,
) -> list[HeatmapRows]:
    """Rows of meshes one after the other.

    Args:
        trees: Of the meshes.
        surfaces: The same, as arrays of NumPy; padding at the end.
        masses: Theirs.
        counts: Vertices and faces of each mesh.
        hand: What does the grasping.
        config: Settings.
    """
    from mjx_grasp.geometry.bvh import FaceGrids
    from mjx_grasp.geometry.warp_device import in_threads

    vertices = sum(v for v, _ in counts)
    owner = np.repeat(np.arange(len(counts), dtype=np.int32), [v for v, _ in counts])
    owner = np.concatenate([owner, owner[-1:].repeat(len(surfaces.vertices) - vertices)])
    given = surfaces, masses, Thumbs(surfaces.vertices, surfaces.normals, owner)
    parts = _parts()
    surfaces, masses, thumbs, directions = _split(pack(given), Layout.of(given), parts)
    grids = FaceGrids(
        trees,
        surfaces.centroids,
        surfaces.face_normals,
        surfaces.areas,
        radius=config.curvature_radius,
        min_faces=config.curvature_min_faces,
    )

    def part(k: int) -> Any:
        own = thumbs[k]
        asked = min(max(vertices - k * len(own.owner), 0), len(own.owner))
        face = trees.farthest_faces(own.owner, own.points, directions[k])
        hits, opposing, normals, tangents = _met(surfaces, own, directions[k], face, config)
        spread = grids.normal_spread(own.owner, opposing, normals, tangents, asked)
        long_axis, seeds = _seeded(masses, own, opposing, normals, spread, config)
        near = trees.nearest_faces(own.owner, seeds, face, 2, asked)
        nearest = _projected(surfaces, seeds, near)
        found = hits, opposing, long_axis, nearest, near >= 0
        return _scored(surfaces, masses, own, *found, hand, config)

    # Cut on the host: on the device each size of a mesh would compile a program.
    found = jax.device_get(in_threads(part, range(parts)))
    row = jax.tree.map(lambda *x: np.concatenate(x), *found)
    ends = np.cumsum([v for v, _ in counts])
    each = [
        jax.tree.map(lambda x, end=end, v=v: x[end - v : end], row)
        for end, (v, _) in zip(ends, counts, strict=True)
    ]
    return jax.device_put(each)


def _parts() -> int:
    """Parts of the work: on a CPU one for each core."""
    return usable_cores() if jax.default_backend() == "cpu" else 1


@partial(jax.jit, static_argnums=(1, 2))
def _split(
    words: UInt32[Array, " words"], layout: Layout, parts: int
) -> tuple[Surfaces, Masses, list[Thumbs], list[Float[Array, "_ 3"]]]:
    """With the thumbs cut into parts, and the directions of their rays."""
    surfaces, masses, thumbs = unpack_on_device(words, layout)
    size = -(-len(thumbs.owner) // parts)
    split = [
        jax.tree.map(lambda x, k=k: x[k * size : (k + 1) * size], thumbs) for k in range(parts)
    ]
    return surfaces, masses, split, [-t.normals for t in split]


@partial(jax.jit, static_argnames="config")
def _met(
    surfaces: Surfaces,
    thumbs: Thumbs,
    directions: Float[Array, "n 3"],
    face: Int[Array, " n"],
    config: HeatmapConfig,
) -> tuple[
    RayHits,
    Float[Array, "n 3"],
    Float[Array, "n 3"],
    tuple[Float[Array, "n 3"], Float[Array, "n 3"]],
]:
    least = config.min_ray_fraction * surfaces.diagonal[thumbs.owner]
    triangles = surfaces.vertices[surfaces.faces]
    hits = hit_on_face(thumbs.points, directions, triangles, face, least)
    opposing, normals = opposing_contacts(surfaces, thumbs, hits)
    return hits, opposing, normals, tangent_basis(normals)


@partial(jax.jit, static_argnames="config")
def _seeded(
    masses: Masses,
    thumbs: Thumbs,
    opposing: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    spread: Float[Array, "n 3"],
    config: HeatmapConfig,
) -> tuple[Float[Array, "n 3"], Float[Array, "m 3"]]:
    long_axis = long_axes(masses, thumbs, spread, normals, config)
    return long_axis, wrap_seeds(opposing, long_axis, config.wrap_offsets).reshape(-1, 3)


@jax.jit
def _projected(
    surfaces: Surfaces, seeds: Float[Array, "m 3"], face: Int[Array, " m"]
) -> ClosestPoints:
    return closest_on_face(seeds, surfaces.vertices[surfaces.faces], jnp.maximum(face, 0))


# Compiled apart from what comes before: each of its many terms would compute that again.
_scored = jax.jit(best_candidates, static_argnames="config")
