"""Inside and outside of closed meshes, against shapes whose inside is known."""

import numpy as np
import pytest
import trimesh

from mjx_grasp.objects.surface import inside, outside_distance

POINTS = np.random.default_rng(0).uniform(-0.08, 0.08, (3000, 3))


def joined(*meshes):
    return trimesh.util.concatenate(meshes)


def clear_of(distance):
    """Points that are not so near a surface that its facets decide."""
    return np.abs(distance) > 0.002


def test_overlapping_balls_count_as_their_union():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    both = joined(ball, ball.copy().apply_translation((0.03, 0.0, 0.0)))
    near = np.minimum(np.linalg.norm(POINTS, axis=1), np.linalg.norm(POINTS - (0.03, 0, 0), axis=1))
    clear = clear_of(near - 0.04)
    np.testing.assert_array_equal(inside(both, POINTS)[clear], (near < 0.04)[clear])
    away = outside_distance(both, POINTS)
    np.testing.assert_allclose(away, np.maximum(near - 0.04, 0.0), atol=5e-4)


def test_a_cavity_is_outside():
    wall = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    wall.invert()
    shell = joined(trimesh.creation.icosphere(subdivisions=3, radius=0.06), wall)
    radius = np.linalg.norm(POINTS, axis=1)
    clear = clear_of(radius - 0.03) & clear_of(radius - 0.06)
    expected = (radius > 0.03) & (radius < 0.06)
    np.testing.assert_array_equal(inside(shell, POINTS)[clear], expected[clear])


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_long_triangles_and_rays_through_corners(shift):
    box = trimesh.creation.box(extents=(0.1, 0.06, 0.08)).apply_translation((shift, 0.0, 0.0))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.06, 0.06, 13)] * 3), axis=-1).reshape(-1, 3)
    grid = grid[(np.abs(np.abs(grid) - (0.05, 0.03, 0.04)) > 1e-6).all(axis=1)]
    expected = (np.abs(grid) < (0.05, 0.03, 0.04)).all(axis=1)
    np.testing.assert_array_equal(inside(box, grid + np.array([shift, 0.0, 0.0])), expected)
