"""Signed distances against trimesh and dense sampling, gradients against finite differences."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import InputError, MjxGraspError
from mjx_grasp.geometry.distance_field import distance_field
from mjx_grasp.geometry.mesh import is_closed
from mjx_grasp.geometry.segments import closest_between_segments
from mjx_grasp.geometry.signed_distance import (
    Box,
    Cylinder,
    Sphere,
    distance_and_normal,
    signed_distance,
)
from mjx_grasp.objects.parametric import stand_in

SHAPES = {
    "sphere": (Sphere(jnp.float32(0.03)), lambda: trimesh.creation.icosphere(5, 0.03), 1e-4),
    "cylinder": (
        Cylinder(jnp.float32(0.03), jnp.float32(0.06)),
        lambda: trimesh.creation.cylinder(radius=0.03, height=0.12, sections=256),
        1e-4,
    ),
    "box": (
        Box(jnp.array([0.02, 0.03, 0.05], jnp.float32)),
        lambda: trimesh.creation.box(extents=(0.04, 0.06, 0.1)),
        2e-6,
    ),
}


def _points(count=400, seed=0):
    return np.random.default_rng(seed).uniform(-0.12, 0.12, (count, 3)).astype(np.float32)


@pytest.mark.parametrize("name", SHAPES)
def test_distance_agrees_with_a_fine_mesh(name):
    shape, mesh, tolerance = SHAPES[name]
    mesh, points = mesh(), _points()
    expected = -trimesh.proximity.signed_distance(mesh, points)
    np.testing.assert_allclose(
        signed_distance(shape, jnp.asarray(points)), expected, atol=tolerance
    )


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_the_gradient(name):
    shape, _, _ = SHAPES[name]
    points = _points().astype(np.float64)
    with jax.enable_x64(True):
        shape = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), shape)
        _, normal = distance_and_normal(shape, jnp.asarray(points))
        step, slope = 1e-6, []
        for axis in np.eye(3):
            ahead = signed_distance(shape, jnp.asarray(points + step * axis))
            behind = signed_distance(shape, jnp.asarray(points - step * axis))
            slope.append((ahead - behind) / (2 * step))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-9)
    error = np.linalg.norm(np.stack(slope, axis=-1) - normal, axis=-1)
    # Only points within a step of a ridge, where the gradient jumps, may differ.
    assert np.mean(error < 1e-5) > 0.99


@pytest.mark.parametrize("name", SHAPES)
def test_degenerate_points_are_finite(name):
    shape, _, _ = SHAPES[name]
    points = jnp.array([[0.0, 0, 0], [0, 0, 0.06], [0, 0, -1.0], [0.03, 0, 0.0]])
    distance, normal = distance_and_normal(shape, points)
    assert np.isfinite(distance).all() and np.isfinite(normal).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-6)


def test_a_batch_of_sizes_is_a_vmap():
    radius = jnp.array([0.02, 0.03, 0.04])
    half = jnp.array([0.05, 0.06, 0.07])
    points = jnp.asarray(_points(30))
    together = jax.vmap(lambda r, h: signed_distance(Cylinder(r, h), points))(radius, half)
    for k in range(3):
        alone = signed_distance(Cylinder(radius[k], half[k]), points)
        np.testing.assert_allclose(together[k], alone, atol=1e-7)


def test_segments_against_dense_sampling():
    rng = np.random.default_rng(1)
    ends = rng.uniform(-1, 1, (200, 4, 3))
    ends[:20, 3] = ends[:20, 2] + (ends[:20, 1] - ends[:20, 0])  # parallel
    ends[20:30, 1] = ends[20:30, 0]  # a point
    p, q = closest_between_segments(*(jnp.asarray(ends[:, k], jnp.float32) for k in range(4)))
    t = np.linspace(0, 1, 301)
    a = ends[:, 0, None] + t[:, None] * (ends[:, 1] - ends[:, 0])[:, None]
    b = ends[:, 2, None] + t[:, None] * (ends[:, 3] - ends[:, 2])[:, None]
    least = np.array(
        [np.linalg.norm(x[:, None] - y[None], axis=-1).min() for x, y in zip(a, b, strict=True)]
    )
    found = np.linalg.norm(np.asarray(p) - np.asarray(q), axis=-1)
    assert np.all(found <= least + 1e-5)
    assert np.all(found >= least - 6e-3)


def winding_number(points, triangles):
    """Of each point, in double precision: solid angles of all faces (Van Oosterom, Strackee 1983).

    1 inside, 0 outside, more where parts overlap, between near a gap.
    """
    total = np.zeros(len(points))
    for triangle in np.asarray(triangles, float):
        a, b, c = triangle[:, None] - points
        la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
        volume = np.sum(a * np.cross(b, c), axis=-1)
        cosines = [np.sum(x * y, axis=-1) for x, y in ((a, b), (b, c), (c, a))]
        below = la * lb * lc + cosines[0] * lc + cosines[1] * la + cosines[2] * lb
        total += np.arctan2(volume, below)
    return total / (2 * np.pi)


def _compared(mesh, count, near=0.01):
    """Points on a surface and near it: errors of the mesh's field in [m], and wrong signs [-]."""
    field = distance_field(mesh.vertices, mesh.faces)
    rng = np.random.default_rng(0)
    on, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    along = rng.uniform(-near, near, (count, 1)) * mesh.face_normals[face]
    points = np.concatenate([on, on + along])
    _, exact, _ = trimesh.proximity.closest_point(mesh, points)
    inside = winding_number(points, mesh.triangles) > 0.5
    found = np.asarray(signed_distance(field, jnp.asarray(points, jnp.float32)))
    clear = exact > 0.5 * float(field.spacing)
    wrong = (found < 0)[clear] != inside[clear]
    return np.abs(found - np.where(inside, -exact, exact)), wrong.mean(), field


@pytest.mark.parametrize("name", [pytest.param("tomato_soup_can", marks=pytest.mark.long), "mug"])
def test_field_of_a_stand_in(name):
    mesh = stand_in(name)
    error, wrong, field = _compared(mesh, count=400)
    assert error.max() < 1e-3
    assert wrong == 0
    far = jnp.asarray(mesh.bounds[1] + 0.3, jnp.float32)
    beyond, outwards = distance_and_normal(field, far)
    _, exact, _ = trimesh.proximity.closest_point(mesh, np.asarray(far)[None])
    # By way of the grid's border, which is no shorter.
    assert exact[0] - 1e-3 < float(beyond) == pytest.approx(exact[0], rel=0.15)
    assert np.asarray(outwards) @ np.ones(3) > 0


def _outwards(mesh, field, points):
    """Distances, signs, and directions away from the inside, by trimesh's nearest points."""
    nearest, distance, _ = trimesh.proximity.closest_point(mesh, points)
    inside = np.asarray(signed_distance(field, jnp.asarray(points, jnp.float32))) < 0
    away = (points - nearest) / np.maximum(distance, 1e-12)[:, None]
    return distance, np.where(inside, -1.0, 1.0), np.where(inside[:, None], -away, away)


def _angles(first, second):
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.rad2deg(np.arctan2(sine, np.sum(first * second, axis=1)))


@pytest.mark.parametrize("name", [pytest.param("tomato_soup_can", marks=pytest.mark.long), "mug"])
def test_normals_of_a_field(name):
    """Slopes of its own distances, and directions of trimesh's nearest points, nearly of length 1.

    Not within half a cell of the surface nor one cell of the medial axis, where directions jump.
    """
    mesh = stand_in(name)
    field = distance_field(mesh.vertices, mesh.faces)
    cell = float(field.spacing)
    on, face = trimesh.sample.sample_surface(mesh, 120, seed=2)
    off = np.random.default_rng(2).uniform(-0.01, 0.01, (120, 1))
    points = on + off * mesh.face_normals[face]
    distance, sign, exact = _outwards(mesh, field, points)
    # To the faces and corners of a cube. The nearest of several parts changes where the direction
    # turns against the step outside, with it inside.
    steps = np.array([d for d in np.ndindex(3, 3, 3) if d.count(1) in (0, 2)]) - 1.0
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    _, _, there = _outwards(mesh, field, (points[:, None] + cell * steps).reshape(-1, 3))
    turned = np.sum((there.reshape(120, -1, 3) - exact[:, None]) * steps, axis=-1)
    clear = (distance > 0.5 * cell) & (np.max(-sign[:, None] * turned, axis=1) < 0.3)
    assert np.sum(clear) > 60
    points, exact = points[clear], exact[clear]

    normal = np.asarray(distance_and_normal(field, jnp.asarray(points, jnp.float32))[1], float)
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), field)
        ahead, behind = (
            np.stack([signed_distance(double, jnp.asarray(points + h * e)) for e in np.eye(3)], -1)
            for h in (1e-6, -1e-6)
        )
    # A cell's border between the two sides changes the slope.
    off_slope = np.linalg.norm((ahead - behind) / 2e-6 - normal, axis=1)
    assert np.percentile(off_slope, 95) < 1e-4
    to_exact = _angles(normal, exact)
    assert np.median(to_exact) < 0.5 and np.percentile(to_exact, 95) < 6.0
    off_length = np.abs(np.linalg.norm(normal, axis=1) - 1)
    assert np.median(off_length) < 0.002 and np.percentile(off_length, 95) < 0.03


def test_grid_points_have_the_distances_of_a_ball():
    """Outside to within the facets of a ball of 20,480, at every grid point."""
    mesh = trimesh.creation.icosphere(5, 0.03)
    field = distance_field(mesh.vertices, mesh.faces, 0.004, 0.012)
    place = np.stack(np.meshgrid(*(np.arange(n) for n in field.values.shape), indexing="ij"), -1)
    points = np.asarray(field.origin, float) + 0.004 * place
    exact = np.linalg.norm(points, axis=-1) - 0.03
    np.testing.assert_allclose(field.values, exact, atol=3e-5)


def _boxes(*places):
    boxes = [trimesh.creation.box(extents=(0.04, 0.05, 0.06)) for _ in places]
    return trimesh.util.concatenate(
        [b.apply_translation(p) for b, p in zip(boxes, places, strict=True)]
    )


def _box_distance(points, centre):
    half = jnp.array([0.02, 0.025, 0.03], jnp.float32)
    return np.asarray(signed_distance(Box(half), jnp.asarray(points - centre, jnp.float32)))


def test_overlapping_parts_are_their_union():
    """Where two boxes overlap it is inside, though the surface winds around it twice."""
    places = np.array([[-0.01, 0.003, 0], [0.012, 0, 0.004]])
    mesh = _boxes(*places)
    assert is_closed(mesh.faces, mesh.vertices)
    field = distance_field(mesh.vertices, mesh.faces)
    points = _points(2000) / 3
    both = np.stack([_box_distance(points, place) for place in places])
    assert np.sum((both < -0.002).all(axis=0)) > 50
    clear = np.abs(both).min(axis=0) > 0.002
    found = np.asarray(signed_distance(field, jnp.asarray(points)))
    np.testing.assert_array_equal((found < 0)[clear], (both < 0).any(axis=0)[clear])
    outside = (both > 0.002).all(axis=0)
    np.testing.assert_allclose(found[outside], both.min(axis=0)[outside], atol=1e-3)


@pytest.mark.long
def test_a_gap_leaves_the_inside_inside():
    """A ball whose top is missing: inside is what the rest winds around by more than half."""
    ball = trimesh.creation.icosphere(4, 0.03)
    faces = ball.faces[ball.triangles_center[:, 2] < 0.022]
    assert is_closed(ball.faces, ball.vertices) and not is_closed(faces, ball.vertices)
    field = distance_field(ball.vertices, faces, 0.002)
    points = _points(1500) / 3
    winding = winding_number(points, ball.vertices[faces])
    clear = (np.abs(np.linalg.norm(points, axis=1) - 0.03) > 0.003) & (np.abs(winding - 0.5) > 0.1)
    found = np.asarray(signed_distance(field, jnp.asarray(points)))
    assert np.sum(clear & (winding > 0.6)) > 100
    np.testing.assert_array_equal((found < 0)[clear], (winding > 0.5)[clear])
    assert float(signed_distance(field, jnp.zeros(3))) < -0.02
    assert float(signed_distance(field, jnp.array([0.0, 0.0, 0.035]))) > 0


def test_seams_do_not_open_a_surface():
    """Vertices of one place count as one; a face missing, or turned over, is a boundary."""
    mesh = _boxes([0.0, 0, 0])
    soup = mesh.triangles.reshape(-1, 3)
    faces = np.arange(len(soup)).reshape(-1, 3)
    assert is_closed(faces, soup)
    assert not is_closed(faces[1:], soup)
    assert not is_closed(np.concatenate([faces[1:], faces[:1, ::-1]]), soup)


@pytest.mark.parametrize("faces", [np.zeros((0, 3), int), np.array([[0, 1, 1]])])
def test_field_refuses_nothing_to_measure(faces):
    with pytest.raises(InputError, match="faces"):
        distance_field(np.eye(3), faces)


@pytest.mark.long
@pytest.mark.skipif(
    "MJX_GRASP_SCANS" not in os.environ, reason="needs the scans' folder in MJX_GRASP_SCANS"
)
def test_fields_of_all_scans():
    """Error at most 1 mm near the surface, and the right sign, on every scan."""
    from mjx_grasp.objects.catalogue import load_catalogue
    from mjx_grasp.objects.model import _mesh

    folder = Path(os.environ["MJX_GRASP_SCANS"])
    failures, compared = {}, 0
    for name in load_catalogue():
        try:
            mesh = _mesh(name, folder)
        except MjxGraspError:
            continue  # no scan of this object
        error, wrong, *_ = _compared(mesh, count=250)
        compared += 1
        if error.max() > 1e-3 or wrong > 0:
            failures[name] = (float(error.max()), float(wrong))
    assert compared and not failures
