import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mjx_grasp.geometry.curvature import axes_of_spread, normal_spread, tangent_basis
from mjx_grasp.geometry.mesh import principal_frame
from mjx_grasp.geometry.vectors import angle_between, distance_to_line, unit


def long_axes(points, normals, centroids, face_normals, face_areas, axes, radius=0.015):
    surface = centroids, face_normals, face_areas
    spread = normal_spread(points, normals, *surface, radius=radius, min_faces=12)
    limits = {"isotropy": 0.05, "flatness": 1e-4, "parallel_angle": np.radians(10)}
    return axes_of_spread(spread, normals, axes, **limits)


def axes_on(mesh, points, normals, **changes):
    properties = principal_frame(mesh.vertices, mesh.faces)
    return np.asarray(
        long_axes(
            jnp.float32(points),
            jnp.float32(normals),
            jnp.float32(mesh.triangles_center),
            jnp.float32(mesh.face_normals),
            jnp.float32(mesh.area_faces),
            jnp.float32(properties.axes),
            **changes,
        )
    )


@pytest.mark.parametrize("radius", [0.02, 0.04])
@pytest.mark.parametrize("seed", range(3))
def test_on_a_cylinder_it_runs_lengthwise(radius, seed):
    # A short cylinder: its longest principal axis is across, so only the curvature can tell.
    mesh = trimesh.creation.cylinder(radius=radius, height=0.06, sections=64)
    for _ in range(2):
        mesh = mesh.subdivide()
    angles = np.linspace(0, 6, 11)
    normals = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    turn = Rotation.random(random_state=seed).as_matrix()
    points = radius * normals @ turn.T
    mesh.vertices = mesh.vertices @ turn.T
    found = axes_on(mesh, points, normals @ turn.T)
    assert np.all(np.abs(found @ turn[:, 2]) > np.cos(np.radians(3)))


def test_on_a_plane_it_follows_the_longest_axis_and_on_its_ends_the_next():
    mesh = trimesh.creation.box(extents=[0.08, 0.04, 0.16])
    for _ in range(4):
        mesh = mesh.subdivide()
    broad = axes_on(mesh, [[0, 0.02, 0]], [[0, 1, 0]])
    end = axes_on(mesh, [[0, 0, 0.08]], [[0, 0, 1]])
    assert abs(broad[0, 2]) == pytest.approx(1, abs=1e-4)
    assert abs(end[0, 0]) == pytest.approx(1, abs=1e-4)


def test_few_faces_near_are_made_up_from_the_nearest():
    # The ends of a 12 cm prism of 24 sides: no centroid within 1 mm, yet the twelve nearest tell.
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.12, sections=24)
    found = axes_on(mesh, [[0.02, 0, 0]], [[1, 0, 0]], radius=0.001)
    assert abs(found[0, 2]) > 0.99


def test_always_a_finite_unit_tangent():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    found = axes_on(sphere, sphere.vertices, sphere.vertex_normals)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.abs(np.sum(found * sphere.vertex_normals, axis=1)).max() < 1e-5
    flat = trimesh.Trimesh([[0, 0, 0], [0, 0, 0], [1e-3, 0, 0]], [[0, 1, 2]], process=False)
    nothing = long_axes(
        jnp.zeros((1, 3)),
        jnp.float32([[0, 0, 1]]),
        jnp.zeros((1, 3)),
        jnp.zeros((1, 3)),
        jnp.zeros(1),
        jnp.float32(principal_frame(flat.vertices, flat.faces).axes),
    )
    assert np.isfinite(nothing).all()


def test_tangent_basis_is_orthonormal_everywhere():
    rng = np.random.default_rng(0)
    n = rng.normal(size=(200, 3))
    n = np.concatenate([n, np.eye(3), -np.eye(3), [[1e-4, 0, -1]]])
    n = jnp.float32(n / np.linalg.norm(n, axis=1, keepdims=True))
    frame = np.stack([*tangent_basis(n), n], axis=-1)
    assert np.allclose(np.swapaxes(frame, 1, 2) @ frame, np.eye(3), atol=1e-5)


def test_mass_properties_agree_with_trimesh():
    # A cone, whose surface has another centre than its volume, with three different moments.
    mesh = trimesh.creation.cone(radius=0.02, height=0.08).apply_scale([1.0, 2.0, 1.0])
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.3])))
    mesh.apply_translation([0.3, -0.2, 0.1])
    found = principal_frame(mesh.vertices, mesh.faces)
    assert np.allclose(found.centre, mesh.center_mass, atol=1e-9)
    inertia = found.axes @ mesh.moment_inertia @ found.axes.T
    assert np.allclose(inertia, np.diag(np.diag(inertia)), atol=1e-12)
    assert np.all(np.diff(np.diag(inertia)) > 0)


def test_an_open_mesh_takes_its_surface():
    mesh = trimesh.creation.box(extents=[0.1, 0.1, 0.1])
    mesh.update_faces(mesh.face_normals[:, 2] < 0.9)
    found = principal_frame(mesh.vertices, mesh.faces)
    # Five faces of a cube: the bottom one at −5 cm, four around 0.
    assert np.allclose(found.centre, [0, 0, -0.01], atol=1e-9)


def test_vector_laws_stay_finite_at_their_edges():
    zero = jnp.zeros(3)
    x = jnp.float32([1, 0, 0])
    assert np.array_equal(unit(zero), zero)
    assert np.allclose(unit(1e-30 * x), x)
    assert float(angle_between(x, -x)) == pytest.approx(np.pi, abs=1e-6)
    assert float(angle_between(x, jnp.float32([1, 1e-5, 0]))) == pytest.approx(1e-5, rel=1e-3)
    assert float(distance_to_line(jnp.float32([5, 3, 4]), zero, x)) == pytest.approx(5)
    assert np.isfinite(jax.jit(angle_between)(zero, x))
