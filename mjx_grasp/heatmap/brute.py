"""Candidates of meshes by every face, in JAX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from mjx_grasp.geometry.closest import closest_on_mesh
from mjx_grasp.geometry.curvature import normal_spread
from mjx_grasp.geometry.packing import Layout, pack, unpack_on_device
from mjx_grasp.geometry.rays import RayHits, farthest_hit
from mjx_grasp.geometry.tiles import tile_for
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

T = TypeVar("T")

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
        long_axis = long_axes(masses, thumbs, spread, normals, config)
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
