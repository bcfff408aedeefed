import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.objects.refine import refined


def longest(mesh):
    return mesh.edges_unique_length.max()


@given(st.integers(0, 1000), st.sampled_from([0.004, 0.01, 0.03]))
def test_edges_are_short_and_the_solid_is_the_same(seed, edge):
    rng = np.random.default_rng(seed)
    mesh = trimesh.convex.convex_hull(rng.uniform(-0.05, 0.05, (12, 3)))
    fine = refined(mesh, edge)
    assert longest(fine) <= edge + 1e-12
    assert fine.is_watertight and fine.is_winding_consistent
    assert fine.volume == pytest.approx(mesh.volume)
    assert fine.area == pytest.approx(mesh.area)
    assert np.array_equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)
    normals = np.unique(np.round(mesh.face_normals, 6), axis=0)
    gap = np.abs(fine.face_normals[:, None] - normals).max(axis=2).min(axis=1)
    assert gap[fine.area_faces > 1e-9].max() < 1e-4


def test_fine_meshes_and_edge_zero_are_left_alone():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    assert np.array_equal(refined(ball, 0.01).faces, ball.faces)
    box = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    assert refined(box, 0.0) is box


def test_a_very_large_surface_gets_longer_edges_instead_of_millions_of_faces():
    hall = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    fine = refined(hall, 0.002)
    assert 5_000 < len(fine.faces) < 60_000
    assert fine.is_watertight
