"""How a solid's surface is cut into triangles does not decide how it can be grasped."""

import numpy as np
import pytest
import trimesh

from mjx_grasp.geometry.mesh import vertex_areas
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.heatmap.compute import heatmap_surface
from mjx_grasp.heatmap.meshes import heatmap_of_mesh

GRIP = (0.02, 0.09), 0.5


def box(rounds):
    mesh = trimesh.creation.box(extents=(0.05, 0.09, 0.12))
    for _ in range(rounds):
        mesh = mesh.subdivide()
    return mesh


def cylinder(sections, rounds):
    mesh = trimesh.creation.cylinder(radius=0.033, height=0.15, sections=sections)
    for _ in range(rounds):
        mesh = mesh.subdivide()
    return mesh


def permuted(mesh, seed):
    """The same triangles: vertices, faces and the corner a face begins with in another order."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    turn = (rng.integers(0, 3, (len(faces), 1)) + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    return trimesh.Trimesh(mesh.vertices[order], faces, process=False)


def summary(mesh):
    """The best score, and the share of the surface that is eligible."""
    stored = heatmap_of_mesh("solid", mesh, GRIP)
    score = stored.heatmap.score
    area = vertex_areas(np.float64(stored.heatmap.vertices), stored.faces)
    suits = score >= SamplingConfig().min_score
    return float(score.max()), float(area[suits].sum() / area.sum())


@pytest.mark.parametrize(
    ("coarse", "fine"),
    [
        (box(0), box(5)),
        (cylinder(32, 0), cylinder(32, 4)),
        (cylinder(32, 0), cylinder(96, 2)),
        (box(0), permuted(box(0), 0)),
        (cylinder(32, 0), permuted(cylinder(32, 0), 1)),
    ],
    ids=["box", "cylinder", "rounder cylinder", "box permuted", "cylinder permuted"],
)
def test_the_same_solid_in_other_triangles_scores_alike(coarse, fine):
    (best, share), (best_fine, share_fine) = summary(coarse), summary(fine)
    assert best > 0.9
    assert best_fine == pytest.approx(best, rel=0.03)
    # Normals are blunted within an edge length of a sharp edge: 10 mm or 3 mm of it.
    assert share_fine == pytest.approx(share, abs=0.1)


def test_areas_of_vertices_make_up_the_surface():
    surface = heatmap_surface(box(0))
    area = vertex_areas(np.asarray(surface.vertices), np.asarray(surface.faces))
    assert area.shape == (len(surface.vertices),) and np.all(area > 0)
    assert area.sum() == pytest.approx(surface.area)
