import numpy as np
import pytest
import trimesh

from mjx_grasp.viz.raster import Orthographic, fitted, look_from, rasterise

DOWN = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])  # the viewer is above, x to the right


def camera(width=64, height=48, scale=400.0, axes=DOWN):
    return Orthographic(axes, np.zeros(3), scale, width, height)


@pytest.mark.parametrize("azimuth", np.linspace(0, 6, 5))
@pytest.mark.parametrize("elevation", [-1.2, 0.0, 0.5])
def test_cameras_are_right_handed_with_z_up(azimuth, elevation):
    axes = look_from(azimuth, elevation)
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[1, 2] > 0 and axes[0, 2] == pytest.approx(0)
    expected = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)]
    assert np.allclose(axes[2, :2], expected)


def test_pixels_see_what_an_independent_ray_caster_sees():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    mesh.vertices = mesh.vertices * [1, 0.7, 0.9] + 0.004 * np.sin(90 * mesh.vertices[:, [1, 2, 0]])
    eye = fitted(mesh.vertices, look_from(0.7, 0.4), 48, 40)
    seen = rasterise(mesh.vertices, mesh.faces, eye)
    rows, columns = np.mgrid[:40, :48]
    right = (columns + 0.5 - 24) / eye.pixels_per_metre
    up = (20 - rows - 0.5) / eye.pixels_per_metre
    origins = (
        eye.centre + right[..., None] * eye.axes[0] + up[..., None] * eye.axes[1] + eye.axes[2]
    )
    hit, ray, face = mesh.ray.intersects_location(
        origins.reshape(-1, 3), np.tile(-eye.axes[2], (rows.size, 1)), multiple_hits=False
    )
    expected = np.full(rows.size, -1)
    expected[ray] = face
    assert np.mean(seen.face.ravel() != expected) < 0.002
    same = np.flatnonzero(seen.face.ravel()[ray] == face)
    corners = mesh.vertices[mesh.faces[seen.face.ravel()[ray[same]]]]
    points = (corners * seen.weights.reshape(-1, 3)[ray[same]][..., None]).sum(axis=1)
    assert np.allclose(points, hit[same], atol=1e-6)
    near = (hit[same] - eye.centre) @ eye.axes[2]
    assert np.allclose(seen.near.ravel()[ray[same]], near, atol=1e-6)


def test_the_nearer_of_two_triangles_wins_in_any_order():
    low = np.array([[-0.05, -0.05, 0], [0.05, -0.05, 0], [0, 0.05, 0]])
    vertices = np.concatenate([low, low + np.array([0, 0, 0.02])])
    for faces, front in (([[0, 1, 2], [3, 4, 5]], 1), ([[3, 4, 5], [0, 1, 2]], 0)):
        seen = rasterise(vertices, np.array(faces), camera())
        assert set(np.unique(seen.face)) == {-1, front}
        assert seen.near[seen.face >= 0].min() == pytest.approx(0.02)


def test_neighbours_leave_no_gap_and_slivers_and_outsiders_no_trace():
    square = np.array([[-0.04, -0.04, 0], [0.04, -0.04, 0], [0.04, 0.04, 0], [-0.04, 0.04, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 0, 1], [0, 1, 1]])
    seen = rasterise(square, faces, camera(scale=500.0))
    assert (seen.face >= 0).sum() == 40 * 40
    assert set(np.unique(seen.face)) == {-1, 0, 1}
    assert (rasterise(square + np.array([1.0, 0, 0]), faces, camera()).face == -1).all()


def test_a_fitted_camera_shows_everything_and_fills_the_picture():
    mesh = trimesh.creation.box(extents=(0.1, 0.02, 0.3))
    mesh.apply_translation([3.0, -1.0, 0.5])
    eye = fitted(mesh.vertices, look_from(1.0, 0.3), 60, 100, margin=0.05)
    x, y, _ = eye.project(mesh.vertices).T
    assert x.min() >= 3 - 1e-9 and x.max() <= 57 + 1e-9
    assert y.min() >= 5 - 1e-9 and y.max() <= 95 + 1e-9
    assert np.isclose(y.min(), 5) or np.isclose(x.min(), 3)
