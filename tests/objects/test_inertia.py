"""Mass properties against formulas, and their behaviour under rigid motions and scale."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mjx_grasp.objects.inertia import mass_properties

MASS = 0.35
SIZE = st.floats(0.01, 0.3)


def lumpy():
    """A body without symmetry, closed: a box with one corner pulled out."""
    mesh = trimesh.creation.box(extents=(0.06, 0.09, 0.04))
    vertices = np.array(mesh.vertices)
    vertices[np.argmax(vertices.sum(axis=1))] += (0.02, 0.01, 0.03)
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


@given(st.tuples(SIZE, SIZE, SIZE))
def test_box(extents):
    com, inertia = mass_properties(trimesh.creation.box(extents=extents), MASS)
    square = np.square(extents)
    exact = MASS / 12.0 * np.diag(square.sum() - square)
    np.testing.assert_allclose(com, 0.0, atol=1e-12)
    np.testing.assert_allclose(inertia, exact, rtol=1e-9, atol=1e-9 * exact.max())


@given(SIZE, SIZE)
def test_cylinder(radius, height):
    sections = 256
    mesh = trimesh.creation.cylinder(radius=radius, height=height, sections=sections)
    com, inertia = mass_properties(mesh, MASS)
    # The mesh is a prism on a regular polygon: its second moment is exact in closed form.
    turn = 2.0 * np.pi / sections
    share = (2.0 + np.cos(turn)) / 3.0
    axial = 0.5 * MASS * radius**2 * share
    exact = np.diag([axial / 2 + MASS * height**2 / 12] * 2 + [axial])
    np.testing.assert_allclose(com, 0.0, atol=1e-12)
    np.testing.assert_allclose(inertia, exact, rtol=1e-8, atol=1e-8 * exact.max())


@given(SIZE)
def test_sphere(radius):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    com, inertia = mass_properties(mesh, MASS)
    np.testing.assert_allclose(com, 0.0, atol=1e-9)
    exact = 0.4 * MASS * radius**2 * np.eye(3)
    np.testing.assert_allclose(inertia, exact, rtol=4e-3, atol=1e-6 * exact.max())
    assert inertia[0, 0] < exact[0, 0]  # an icosphere lies within its sphere


@given(
    arrays(float, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 0.1),
    arrays(float, 3, elements=st.floats(-2.0, 2.0)),
)
def test_rigid_motion_moves_the_com_and_turns_the_inertia(quat, shift):
    mesh = lumpy()
    R = Rotation.from_quat(quat).as_matrix()
    moved = trimesh.Trimesh(mesh.vertices @ R.T + shift, mesh.faces, process=False)
    com, inertia = mass_properties(mesh, MASS)
    com_moved, inertia_moved = mass_properties(moved, MASS)
    np.testing.assert_allclose(com_moved, R @ com + shift, atol=1e-10)
    np.testing.assert_allclose(inertia_moved, R @ inertia @ R.T, atol=1e-8 * inertia.max())


@given(st.floats(0.2, 5.0))
def test_scale_is_linear_in_the_com_and_square_in_the_inertia(scale):
    mesh = lumpy()
    com, inertia = mass_properties(mesh, MASS)
    bigger = trimesh.Trimesh(scale * mesh.vertices, mesh.faces, process=False)
    com_bigger, inertia_bigger = mass_properties(bigger, MASS)
    np.testing.assert_allclose(com_bigger, scale * com, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(inertia_bigger, scale**2 * inertia, rtol=1e-8)


def test_inertia_is_proportional_to_the_mass():
    np.testing.assert_allclose(
        mass_properties(lumpy(), 3.0)[1], 3.0 * mass_properties(lumpy(), 1.0)[1], rtol=1e-12
    )


def test_a_cavity_counts_as_missing():
    outer, inner = 0.04, 0.03
    shell = trimesh.creation.icosphere(subdivisions=4, radius=outer)
    cavity = trimesh.creation.icosphere(subdivisions=4, radius=inner)
    hollow = trimesh.Trimesh(
        np.concatenate([shell.vertices, cavity.vertices]),
        np.concatenate([shell.faces, cavity.faces[:, ::-1] + len(shell.vertices)]),
        process=False,
    )
    exact = 0.4 * MASS * (outer**5 - inner**5) / (outer**3 - inner**3)
    inertia = mass_properties(hollow, MASS)[1]
    np.testing.assert_allclose(np.diag(inertia), exact, rtol=4e-3)


def test_agrees_with_trimesh_on_a_body_without_symmetry():
    mesh = lumpy()
    mesh.density = MASS / mesh.volume
    com, inertia = mass_properties(mesh, MASS)
    np.testing.assert_allclose(com, mesh.center_mass, atol=1e-12)
    np.testing.assert_allclose(inertia, mesh.moment_inertia, rtol=1e-7, atol=1e-12)


def test_inertia_can_be_that_of_a_body():
    moments = np.linalg.eigvalsh(mass_properties(lumpy(), MASS)[1])
    assert moments[0] > 0 and moments[2] < moments[0] + moments[1]


@pytest.mark.parametrize("offset", [1.0, 100.0])
def test_far_from_the_origin_nothing_is_lost(offset):
    mesh = lumpy()
    far = trimesh.Trimesh(mesh.vertices + offset, mesh.faces, process=False)
    inertia = mass_properties(mesh, MASS)[1]
    np.testing.assert_allclose(mass_properties(far, MASS)[1], inertia, rtol=1e-7, atol=1e-11)
