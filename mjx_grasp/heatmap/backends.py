"""The two ways to query meshes: every face in JAX, or hierarchies of NVIDIA Warp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from mjx_grasp.geometry.closest import ClosestPoints, closest_on_face, closest_on_mesh
from mjx_grasp.geometry.curvature import axes_of_spread, normal_spread, tangent_basis
from mjx_grasp.geometry.packing import Layout, pack, unpack_on_device
from mjx_grasp.geometry.rays import RayHits, farthest_hit, hit_on_face
from mjx_grasp.geometry.tiles import tile_for
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

# Faces up to which a GPU is faster with every face than with building a hierarchy (between 10,000
# and 100,000 on an H200: experiments/results/heatmap_h200.json).
_BRUTE_ON_GPU = 12_000

T = TypeVar("T")


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


def backend_for(faces: int, config: HeatmapConfig) -> str:
    """'bvh' or 'brute', for a mesh of so many faces on this device."""
    if config.backend != "auto":
        return config.backend
    platform = jax.default_backend()
    if platform == "cpu":
        return "bvh"
    return "bvh" if platform == "gpu" and faces > _BRUTE_ON_GPU else "brute"


_Found = tuple[RayHits, Float[Array, "*g n 3"], Float[Array, "*g n 3"], Float[Array, "*g n 3"]]


class Begun(NamedTuple):
    """Work that needs no masses, done over all faces: of meshes of the same padded size.

    Attributes:
        words: The meshes' :class:`Surfaces` on the device, ``layout`` says where.
        found: Along the leading axis the rays' hits, points o, normals and their spread there.
    """

    words: UInt32[Array, " words"]
    layout: Layout
    at_once: int
    found: _Found


def begin_brute(stacked: Surfaces, config: HeatmapConfig) -> Begun:
    """Starts on meshes of the same padded size: a GPU works while masses are worked out.

    Args:
        stacked: One mesh each along the leading axis ``[g, …]``, of NumPy.
        config: Settings.
    """
    words, layout, at_once = pack(stacked), Layout.of(stacked), _at_once(stacked, config)
    words = jax.device_put(words)
    return Begun(words, layout, at_once, _begin(words, layout, at_once, config))


def brute_candidates(
    begun: Begun, masses: Masses, hand: GraspLimits, config: HeatmapConfig
) -> HeatmapRows:
    """Goes on to the candidates, which a GPU then works on.

    Args:
        begun: What was done of it.
        masses: Of the meshes, along the leading axis.
        hand: What does the grasping.
        config: Settings.
    """
    given = masses, hand
    fixed = begun.layout, Layout.of(given), begun.at_once, config
    return _finish(begun.words, begun.found, pack(given), *fixed)


@partial(jax.jit, static_argnames="vertices")
def cut_out(stacked: HeatmapRows, mesh: int | Int[Array, ""], vertices: int) -> HeatmapRows:
    """Those of one mesh, without the padding; compiled once for each number of vertices."""
    return jax.tree.map(lambda x: x[mesh, :vertices], stacked)


def _at_once(stacked: Surfaces, config: HeatmapConfig) -> int:
    """As many meshes as fit beside each other where most is asked: the nearest points."""
    vertices, faces = stacked.vertices.shape[1], stacked.areas.shape[1]
    queries = 2 * len(config.wrap_offsets) * vertices
    return min(stacked.areas.shape[0], max(1, tile_for(faces) // queries))


@partial(jax.jit, static_argnums=(1, 2, 3))
def _begin(
    words: UInt32[Array, " words"], layout: Layout, at_once: int, config: HeatmapConfig
) -> _Found:
    def one(surfaces: Surfaces) -> _Found:
        thumbs, vertices = _all_thumbs(surfaces), surfaces.vertices
        tile = config.tile or tile_for(len(surfaces.areas), at_once)
        triangles = vertices[surfaces.faces]
        least = config.min_ray_fraction * surfaces.diagonal[0]
        hits = farthest_hit(vertices, -surfaces.normals, triangles, least, tile)
        opposing, normals = opposing_contacts(surfaces, thumbs, hits)
        spread = normal_spread(
            opposing,
            normals,
            surfaces.centroids,
            surfaces.face_normals,
            surfaces.areas,
            radius=config.curvature_radius,
            min_faces=config.curvature_min_faces,
            tile=tile,
        )
        return hits, opposing, normals, spread

    return _mapped(one, unpack_on_device(words, layout), at_once)


@partial(jax.jit, static_argnums=(3, 4, 5, 6))
def _finish(
    words: UInt32[Array, " words"],
    begun: _Found,
    more_words: UInt32[Array, " more"],
    layout: Layout,
    more_layout: Layout,
    at_once: int,
    config: HeatmapConfig,
) -> HeatmapRows:
    surfaces = unpack_on_device(words, layout)
    masses, hand = unpack_on_device(more_words, more_layout)

    def one(part: tuple[Surfaces, _Found, Masses]) -> HeatmapRows:
        surfaces, (hits, opposing, normals, spread), masses = part
        thumbs = _all_thumbs(surfaces)
        tile = config.tile or tile_for(len(surfaces.areas), at_once)
        long_axis = _axes(masses, thumbs, spread, normals, config)
        seeds = wrap_seeds(opposing, long_axis, config.wrap_offsets).reshape(-1, 3)
        triangles = surfaces.vertices[surfaces.faces]
        nearest = jax.lax.optimization_barrier(closest_on_mesh(seeds, triangles, tile))
        on_mesh = jnp.ones(seeds.shape[0], bool)
        found = hits, opposing, long_axis, nearest, on_mesh
        return best_candidates(surfaces, masses, thumbs, *found, hand, config)

    return _mapped(one, (surfaces, begun, masses), at_once)


def _all_thumbs(surfaces: Surfaces) -> Thumbs:
    """Every vertex, of one mesh."""
    return Thumbs(surfaces.vertices, surfaces.normals, jnp.zeros(len(surfaces.vertices), jnp.int32))


def _mapped(function: Callable[[Any], T], stacked: Any, at_once: int) -> T:
    if at_once == jax.tree.leaves(stacked)[0].shape[0]:
        return jax.vmap(function)(stacked)
    return jax.lax.map(function, stacked, batch_size=at_once)


def _axes(
    masses: Masses,
    thumbs: Thumbs,
    spread: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    config: HeatmapConfig,
) -> Float[Array, "n 3"]:
    return axes_of_spread(
        spread,
        normals,
        masses.axes[thumbs.owner],
        isotropy=config.curvature_isotropy,
        flatness=config.curvature_flatness,
        parallel_angle=config.parallel_angle,
    )


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
    long_axis = _axes(masses, thumbs, spread, normals, config)
    return long_axis, wrap_seeds(opposing, long_axis, config.wrap_offsets).reshape(-1, 3)


@jax.jit
def _projected(
    surfaces: Surfaces, seeds: Float[Array, "m 3"], face: Int[Array, " m"]
) -> ClosestPoints:
    return closest_on_face(seeds, surfaces.vertices[surfaces.faces], jnp.maximum(face, 0))


# Compiled apart from what comes before: each of its many terms would compute that again.
_scored = jax.jit(best_candidates, static_argnames="config")
