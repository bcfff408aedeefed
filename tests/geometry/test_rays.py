import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from mjx_grasp.geometry.rays import farthest_hit
from mjx_grasp.objects.parametric import stand_in


def bumpy(seed):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    directions = rng.normal(size=(6, 3))
    radii = 1 + 0.25 * np.sin(3 * mesh.vertices / 0.05 @ directions.T).mean(axis=1)
    mesh.vertices *= radii[:, None]
    return mesh


def oracle(mesh, origins, directions):
    """Farthest hits by embree: the first hit of the ray cast back from beyond the mesh."""
    far = 4 * np.linalg.norm(mesh.extents)
    locations, rays, _ = RayMeshIntersector(mesh).intersects_location(
        origins + far * directions, -directions, multiple_hits=False
    )
    distance = np.full(len(origins), -np.inf)
    distance[rays] = np.einsum("ni,ni->n", locations - origins[rays], directions[rays])
    return distance


def check_against_embree(mesh, share):
    origins = mesh.vertices
    directions = -mesh.vertex_normals
    min_distance = 1e-4 * np.linalg.norm(mesh.extents)
    hits = farthest_hit(
        jnp.float32(origins), jnp.float32(directions), jnp.float32(mesh.triangles), min_distance
    )
    expected = oracle(mesh, origins, directions)
    # Hits within a rounding of the threshold are either.
    clear = np.abs(expected - min_distance) > 0.1 * min_distance
    agree = np.asarray(hits.hit) == (expected > min_distance)
    both = np.asarray(hits.hit) & (expected > min_distance)
    agree[both] &= np.abs(np.asarray(hits.distance) - expected)[both] < 2e-5
    # What is left are rays that graze an edge, where either caster may miss a face.
    assert agree[clear].mean() >= share
    assert clear.mean() > 0.9
    assert both.mean() > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_farthest_hit_agrees_with_embree_on_bumpy_meshes(seed):
    check_against_embree(bumpy(seed), 0.998)


OTHERS = ("sugar_box", "tomato_soup_can", "apple")


@pytest.mark.parametrize(
    "name", ["mug", *(pytest.param(name, marks=pytest.mark.long) for name in OTHERS)]
)
def test_farthest_hit_agrees_with_embree_on_stand_ins(name):
    check_against_embree(stand_in(name, 1.0), 0.99)


@pytest.mark.skipif("MJX_GRASP_SCANS" not in os.environ, reason="scans may not be committed")
def test_farthest_hit_agrees_with_embree_on_every_scan():
    files = sorted(Path(os.environ["MJX_GRASP_SCANS"]).glob("*.obj"))
    assert files
    for file in files:
        check_against_embree(trimesh.load(file, force="mesh"), 0.99)


def test_hit_point_from_weights_lies_on_the_ray():
    mesh = bumpy(3)
    hits = farthest_hit(
        jnp.float32(mesh.vertices),
        jnp.float32(-mesh.vertex_normals),
        jnp.float32(mesh.triangles),
        0.0,
    )
    on_face = np.einsum("nk,nki->ni", hits.barycentric, mesh.triangles[np.asarray(hits.face)])
    on_ray = mesh.vertices - np.asarray(hits.distance)[:, None] * mesh.vertex_normals
    assert np.asarray(hits.hit).all()
    assert np.abs(on_face - on_ray).max() < 2e-6


def test_of_several_walls_the_farthest_is_taken_and_near_ones_do_not_count():
    wall = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0]], np.float32)
    walls = wall + jnp.float32([-0.1, 0.5, 0.2])[:, None, None] * jnp.float32([0, 0, 1])
    origin, up = jnp.zeros((1, 3)), jnp.float32([[0, 0, 1]])
    hits = farthest_hit(origin, up, walls, 0.0)
    assert int(hits.face[0]) == 1
    assert float(hits.distance[0]) == pytest.approx(0.5)
    assert bool(farthest_hit(origin, up, walls, 0.45).hit[0])
    assert not bool(farthest_hit(origin, up, walls, 0.55).hit[0])
    assert not bool(farthest_hit(origin, jnp.float32([[1, 0, 0]]), walls, 0.0).hit[0])


def test_a_ray_through_shared_edges_and_vertices_does_not_slip_through():
    mesh = trimesh.creation.box(extents=[0.1, 0.1, 0.1]).subdivide().subdivide()
    origins = mesh.vertices[np.abs(mesh.vertices).max(axis=1) > 0.0499]
    top = origins[np.isclose(origins[:, 2], 0.05) & (np.abs(origins[:, :2]).max(axis=1) < 0.049)]
    hits = farthest_hit(
        jnp.float32(top),
        jnp.tile(jnp.float32([0, 0, -1]), (len(top), 1)),
        jnp.float32(mesh.triangles),
        1e-4,
    )
    assert len(top) >= 9
    assert np.allclose(hits.distance, 0.1, atol=1e-6) and np.asarray(hits.hit).all()


def test_degenerate_faces_and_rays_hit_nothing_and_stay_finite():
    triangles = jnp.zeros((3, 3, 3)).at[1, 1:].set(jnp.float32([[1, 0, 0], [2, 0, 0]]))
    hits = farthest_hit(jnp.zeros((2, 3)), jnp.float32([[1, 0, 0], [0, 0, 0]]), triangles, 0.0)
    assert not np.asarray(hits.hit).any()
    assert all(np.isfinite(np.asarray(x, float)).all() for x in hits)


def test_the_tile_does_not_change_the_answer():
    mesh = bumpy(4)
    arguments = (
        jnp.float32(mesh.vertices[:101]),
        jnp.float32(-mesh.vertex_normals[:101]),
        jnp.float32(mesh.triangles),
        1e-4,
    )
    small, large = farthest_hit(*arguments, tile=7), farthest_hit(*arguments, tile=101)
    assert np.array_equal(small.face, large.face)
    assert np.allclose(small.distance, large.distance, atol=1e-7)
