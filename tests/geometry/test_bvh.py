"""Rays by Warp's hierarchies against rays by all faces: none slips through a closed surface."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from shapely.geometry import Polygon

from mjx_grasp.geometry.bvh import MeshTrees
from mjx_grasp.geometry.rays import farthest_hit, hit_on_face

SMALL = 0.02  # edge of a square of the floor plans [m]
L = [(0, 0), (1, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3), (0, 1)]
RING = [
    (0, 0),
    (1, 0),
    (2, 0),
    (3, 0),
    (3, 1),
    (3, 2),
    (3, 3),
    (2, 3),
    (1, 3),
    (0, 3),
    (0, 2),
    (0, 1),
]
HOLE = [(1, 1), (2, 1), (2, 2), (1, 2)]
BOTTLE = np.array([[0, -0.1], [0.033, -0.1], [0.033, 0.05], [0.015, 0.08], [0.015, 0.1], [0, 0.1]])

all_faces = jax.jit(farthest_hit, static_argnames="tile")
named_face = jax.jit(hit_on_face)


def plan(outline, *holes):
    walls = Polygon(SMALL * np.array(outline), [SMALL * np.array(hole) for hole in holes])
    return trimesh.creation.extrude_polygon(walls, 0.04)


SURFACES = {
    "box": lambda: trimesh.creation.box([0.04, 0.05, 0.06]).subdivide().subdivide(),
    "l": lambda: plan(L).subdivide().subdivide(),
    "ring": lambda: plan(RING, HOLE).subdivide().subdivide(),
    "ball": lambda: trimesh.creation.icosphere(3, 0.03),
    "globe": lambda: trimesh.creation.uv_sphere(0.03, count=[16, 16]),
    "can": lambda: trimesh.creation.cylinder(0.03, 0.1, sections=32).subdivide(),
    "bottle_16": lambda: trimesh.creation.revolve(BOTTLE, sections=16).subdivide(),
    "bottle_48": lambda: trimesh.creation.revolve(BOTTLE, sections=48).subdivide(),
}


@functools.cache
def surface(name):
    mesh = SURFACES[name]()
    assert mesh.is_watertight
    return mesh


@pytest.mark.parametrize("name", SURFACES)
def test_no_ray_slips_through_a_closed_surface_at_its_edges(name):
    mesh = surface(name)
    hits, owner = 0, jnp.zeros(len(mesh.vertices), jnp.int32)
    for k in range(8):
        turn = Rotation.random(random_state=k).as_matrix() if k else np.eye(3)
        points = np.float32(mesh.vertices @ turn.T)
        origins, directions = jnp.asarray(points), jnp.float32(-mesh.vertex_normals @ turn.T)
        face = MeshTrees([points], [mesh.faces]).farthest_faces(owner, origins, directions)
        triangles, least = jnp.asarray(points[mesh.faces]), 1e-4 * mesh.scale
        found = named_face(origins, directions, triangles, face, least)
        expected = all_faces(origins, directions, triangles, least)
        assert np.array_equal(found.hit, expected.hit)
        assert np.allclose(found.distance, expected.distance, atol=1e-6)
        hits += int(expected.hit.sum())
    assert hits > 0.9 * 8 * len(mesh.vertices)


def test_what_is_met_just_beside_an_edge_is_met_by_all_faces_too():
    # Of a single face, where no neighbour takes what one of the two refuses.
    corners = np.float32([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    beside = np.float32(np.linspace(-3e-4, 3e-4, 601) * 0.05)
    origins = jnp.asarray(np.column_stack([beside, np.full(601, 0.02), np.full(601, -0.1)]), "f4")
    up, owner = jnp.tile(jnp.float32([0, 0, 1]), (601, 1)), jnp.zeros(601, jnp.int32)
    face = MeshTrees([corners], [np.array([[0, 1, 2]])]).farthest_faces(owner, origins, up)
    named, triangles = np.asarray(face) >= 0, jnp.asarray(corners[None])
    assert np.array_equal(named_face(origins, up, triangles, face, 0.0).hit, named)
    assert named[beside >= 0].all() and not named[beside < -1e-4 * 0.05].any()
