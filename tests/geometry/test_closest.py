import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mjx_grasp.geometry.closest import closest_on_mesh, closest_on_triangle
from mjx_grasp.objects.parametric import stand_in

COORDINATE = st.floats(-1.0, 1.0, width=32)
on_triangle = jax.jit(closest_on_triangle)  # once for the many examples


def sampled_distance(point, triangle, n=60):
    """The distance to a fine grid on the triangle: an upper bound of the true one."""
    v, w = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    keep = v + w <= 1 + 1e-9
    weights = np.stack([1 - v - w, v, w], axis=-1)[keep]
    return np.linalg.norm(weights @ triangle - point, axis=1).min()


@settings(max_examples=150, deadline=None)
@given(arrays(np.float32, 3, elements=COORDINATE), arrays(np.float32, (3, 3), elements=COORDINATE))
def test_nearest_point_is_on_the_triangle_and_none_is_nearer(point, triangle):
    nearest, weights = on_triangle(jnp.asarray(point), jnp.asarray(triangle))
    assert np.all(np.asarray(weights) >= -1e-6)
    assert float(np.sum(weights)) == pytest.approx(1.0, abs=1e-5)
    assert np.allclose(np.asarray(weights) @ triangle, nearest, atol=1e-5)
    distance = np.linalg.norm(np.asarray(nearest) - point)
    assert distance <= sampled_distance(point, triangle) + 2e-4


@pytest.mark.parametrize("same", [(0, 1), (1, 2), (0, 2)])
def test_weights_where_two_corners_are_one(same):
    """Two edges are equally near there, of weights that must not be mixed."""
    triangle, point = np.full((3, 3), 0.75, np.float32), np.float32([0, 0, -0.99731886])
    (other,) = {0, 1, 2} - set(same)
    triangle[other, 0] = 1.0
    nearest, weights = on_triangle(jnp.asarray(point), jnp.asarray(triangle))
    np.testing.assert_allclose(nearest, triangle[same[0]])
    np.testing.assert_allclose(np.asarray(weights) @ triangle, nearest)
    assert float(np.sum(weights)) == 1.0


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([-1, -1, 1], [0, 0, 0]),
        ([3, -1, 0], [1, 0, 0]),
        ([-1, 3, 0], [0, 1, 0]),
        ([0.4, -1, 2], [0.4, 0, 0]),
        ([-1, 0.4, 2], [0, 0.4, 0]),
        ([1, 1, -1], [0.5, 0.5, 0]),
        ([0.2, 0.3, 5], [0.2, 0.3, 0]),
    ],
)
def test_every_region_of_the_unit_triangle(point, expected):
    triangle = jnp.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    nearest, _ = closest_on_triangle(jnp.float32(point), triangle)
    assert np.allclose(nearest, expected, atol=1e-6)


@pytest.mark.parametrize("shape", ["bumpy", "box", "stand-in"])
def test_agrees_with_trimesh(shape):
    rng = np.random.default_rng(0)
    if shape == "bumpy":
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
        mesh.vertices *= 1 + 0.2 * rng.random(len(mesh.vertices))[:, None]
    elif shape == "box":
        mesh = trimesh.creation.box(extents=[0.1, 0.04, 0.16])
    else:
        mesh = stand_in("mug", 1.0)
    points = rng.uniform(mesh.bounds[0] * 1.5, mesh.bounds[1] * 1.5, (150, 3))
    found = closest_on_mesh(jnp.float32(points), jnp.float32(mesh.triangles), tile=64)
    expected, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    assert np.allclose(found.distance, distance, atol=2e-6)
    # Where two faces are equally near, either point is right: compare those that are not.
    same = np.linalg.norm(np.asarray(found.point) - expected, axis=1) < 2e-5
    assert same.mean() > 0.95
    again = np.einsum(
        "nk,nki->ni", np.asarray(found.barycentric), mesh.triangles[np.asarray(found.face)]
    )
    assert np.allclose(again, found.point, atol=2e-6)


def test_points_of_the_surface_are_their_own_nearest():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    points, _ = trimesh.sample.sample_surface(mesh, 300, seed=1)
    found = closest_on_mesh(jnp.float32(points), jnp.float32(mesh.triangles))
    assert np.asarray(found.distance).max() < 1e-7


def test_degenerate_triangles_stay_finite_and_exact():
    ends = jnp.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    # In any order of the corners, with one in the middle or two the same.
    corners = np.array([[0, 1, 2], [0, 2, 1], [0, 0, 2], [0, 2, 2], [0, 2, 0]])
    dot = jnp.float32([[1, 1, 1]] * 3)
    for point in jnp.float32([[0, 0, 0], [0.5, 1, 0], [3, 0, 1], [-1, 0, 0]]):
        on_dot, weights = closest_on_triangle(point, dot)
        for segment in ends[corners]:
            on_segment, _ = closest_on_triangle(point, segment)
            assert np.allclose(on_segment, [jnp.clip(point[0], 0, 2), 0, 0], atol=1e-6)
        assert np.allclose(on_dot, 1) and np.isfinite(weights).all()
