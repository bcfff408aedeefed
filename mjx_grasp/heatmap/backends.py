"""The two ways to query meshes: every face in JAX, or hierarchies of NVIDIA Warp."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.closest import closest_on_face, closest_on_mesh
from mjx_grasp.geometry.curvature import axes_of_spread, normal_spread
from mjx_grasp.geometry.rays import farthest_hit, hit_on_face
from mjx_grasp.geometry.tiles import tile_for
from mjx_grasp.heatmap.candidates import (
    Surfaces,
    best_candidates,
    opposing_contacts,
    wrap_seeds,
)
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap

# Faces up to which a GPU is faster with every face than with building a hierarchy (between 10,000
# and 100,000 on an H200: experiments/results/heatmap_h200.json).
_BRUTE_ON_GPU = 12_000


def backend_for(faces: int, config: HeatmapConfig) -> str:
    """'bvh' or 'brute', for a mesh of so many faces on this device."""
    if config.backend != "auto":
        return config.backend
    platform = jax.default_backend()
    if platform == "cpu":
        return "bvh"
    return "bvh" if platform == "gpu" and faces > _BRUTE_ON_GPU else "brute"


def brute_candidates(
    stacked: Surfaces, span: np.ndarray, friction: np.ndarray, config: HeatmapConfig
) -> Heatmap:
    """Candidates of meshes of the same padded size, over all faces.

    Args:
        stacked: One mesh each along the leading axis ``[g, …]``.
        span: Narrowest and widest grasp, [m].
        friction: μ.
        config: Settings.
    """
    vertices, faces = stacked.vertices.shape[1], stacked.areas.shape[1]
    # As many meshes at once as fit beside each other where most is asked: the nearest points.
    queries = 2 * len(config.wrap_offsets) * vertices
    at_once = min(stacked.areas.shape[0], max(1, tile_for(faces) // queries))
    return _brute(stacked, span, friction, config, at_once)


@partial(jax.jit, static_argnames=("config", "at_once"))
def _brute(stacked, span, friction, config, at_once):
    tile = config.tile or tile_for(stacked.areas.shape[1], at_once)

    def one(surfaces):
        triangles = surfaces.vertices[surfaces.faces]
        least = config.min_ray_fraction * surfaces.diagonal[0]
        hits = farthest_hit(surfaces.vertices, -surfaces.normals, triangles, least, tile)
        opposing, normals = opposing_contacts(surfaces, hits)
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
        long_axis = _axes(surfaces, spread, normals, config)
        seeds = wrap_seeds(opposing, long_axis, config.wrap_offsets).reshape(-1, 3)
        nearest = jax.lax.optimization_barrier(closest_on_mesh(seeds, triangles, tile))
        on_mesh = jnp.ones(seeds.shape[0], bool)
        return best_candidates(
            surfaces, hits, opposing, long_axis, nearest, on_mesh, span, friction, config
        )

    if at_once == stacked.areas.shape[0]:
        return jax.vmap(one)(stacked)
    return jax.lax.map(one, stacked, batch_size=at_once)


def _axes(surfaces, spread, normals, config):
    return axes_of_spread(
        spread,
        normals,
        surfaces.axes[surfaces.owner],
        isotropy=config.curvature_isotropy,
        flatness=config.curvature_flatness,
        parallel_angle=config.parallel_angle,
    )


def bvh_candidates(
    surfaces: Surfaces,
    counts: list[tuple[int, int]],
    span: np.ndarray,
    friction: np.ndarray,
    config: HeatmapConfig,
) -> Heatmap:
    """Candidates of meshes one after the other, through hierarchies.

    Args:
        surfaces: The meshes, as arrays of NumPy; padding at the end.
        counts: Vertices and faces of each mesh.
        span: Narrowest and widest grasp, [m].
        friction: μ.
        config: Settings.
    """
    # Warp takes half a second to import, and only this backend needs it.
    from mjx_grasp.geometry.bvh import MeshTrees

    ends = np.cumsum(counts, axis=0)
    starts = ends - np.asarray(counts)
    trees = MeshTrees(
        [surfaces.vertices[a:b] for a, b in zip(starts[:, 0], ends[:, 0], strict=True)],
        [
            surfaces.faces[a:b] - first
            for a, b, first in zip(starts[:, 1], ends[:, 1], starts[:, 0], strict=True)
        ],
        [surfaces.centroids[a:b] for a, b in zip(starts[:, 1], ends[:, 1], strict=True)],
    )
    count = int(ends[-1, 0])
    surfaces = jax.device_put(surfaces)
    owner, directions = _rays(surfaces)
    face = trees.farthest_faces(owner, surfaces.vertices, directions, count)
    hits, opposing, normals = _met(surfaces, directions, face, config)
    spread = trees.normal_spread(
        owner,
        opposing,
        normals,
        surfaces.centroids,
        surfaces.face_normals,
        surfaces.areas,
        radius=config.curvature_radius,
        min_faces=config.curvature_min_faces,
        count=count,
    )
    long_axis, seeds, seed_owner, bound = _seeded(surfaces, opposing, normals, spread, config)
    near = trees.nearest_faces(seed_owner, seeds, bound).reshape(-1)
    nearest = _projected(surfaces, seeds, near)
    return _scored(surfaces, hits, opposing, long_axis, nearest, near >= 0, span, friction, config)


@jax.jit
def _rays(surfaces: Surfaces) -> tuple[Array, Float[Array, "v 3"]]:
    return surfaces.owner, -surfaces.normals


@partial(jax.jit, static_argnames="config")
def _met(surfaces, directions, face, config):
    least = config.min_ray_fraction * surfaces.diagonal[surfaces.owner]
    triangles = surfaces.vertices[surfaces.faces]
    hits = hit_on_face(surfaces.vertices, directions, triangles, face, least)
    return hits, *opposing_contacts(surfaces, hits)


@partial(jax.jit, static_argnames="config")
def _seeded(surfaces, opposing, normals, spread, config):
    long_axis = _axes(surfaces, spread, normals, config)
    seeds = wrap_seeds(opposing, long_axis, config.wrap_offsets)
    offsets = jnp.asarray(config.wrap_offsets, seeds.dtype)
    # A seed's own o is at h from it; somewhat more, for the search takes what is strictly nearer.
    slack = 1e-3 * surfaces.diagonal[surfaces.owner]
    bound = jnp.broadcast_to((1.01 * offsets)[:, None, None] + slack, seeds.shape[:-1])
    count = len(config.wrap_offsets)
    owner = jnp.tile(surfaces.owner, 2)
    return long_axis, seeds.reshape(count, -1, 3), owner, bound.reshape(count, -1)


@jax.jit
def _projected(surfaces, seeds, face):
    return closest_on_face(
        seeds.reshape(-1, 3), surfaces.vertices[surfaces.faces], jnp.maximum(face, 0)
    )


# Compiled apart from what comes before: each of its many terms would compute that again.
@partial(jax.jit, static_argnames="config")
def _scored(surfaces, hits, opposing, long_axis, nearest, on_mesh, span, friction, config):
    return best_candidates(
        surfaces, hits, opposing, long_axis, nearest, on_mesh, span, friction, config
    )
