"""Convex pieces: limits, corners, coverage, and the outward error against trimesh."""

import hashlib
from functools import cache

import numpy as np
import pytest
import trimesh

from mjx_grasp.objects import convex
from mjx_grasp.objects.convex import ConvexConfig, Division, Piece, convex_pieces, outward_error
from mjx_grasp.objects.hulls import hull_mesh, reduced_hull
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.repair import split

FEW = ConvexConfig(samples=800, divisions=(Division(),))
NAMES = ("foam_brick", "tomato_soup_can", pytest.param("mug", marks=pytest.mark.long))


@pytest.fixture(scope="module")
def divided():
    """Mesh, pieces and outward error by name, made once."""

    @cache
    def made(name):
        mesh = stand_in(name)
        return mesh, *convex_pieces(mesh, FEW)

    return made


def distance(piece, points):
    """Distance outside a piece by trimesh."""
    away = trimesh.proximity.closest_point(piece.surface(), points)[1]
    return np.where(piece.contains(points), 0.0, away)


def inside_union(mesh, points):
    """Whether points lie in any component, by trimesh's rays."""
    return np.any([part.contains(points) for part in split(mesh)], axis=0)


# Hulls


def test_a_box_keeps_its_corners():
    box = trimesh.creation.box(extents=(0.05, 0.08, 0.12))
    dense = box.subdivide().subdivide().subdivide()
    rng = np.random.default_rng(0)
    inner = rng.uniform(-0.5, 0.5, (500, 3)) * box.extents
    kept = reduced_hull(np.concatenate([inner, dense.vertices]), 8)
    assert len(kept) == 8
    np.testing.assert_allclose(np.sort(kept, axis=0), np.sort(box.vertices, axis=0), atol=1e-12)


@pytest.mark.parametrize("name", ["foam_brick", "sugar_box", "potted_meat_can"])
def test_a_rounded_box_loses_less_than_a_millimetre(name):
    mesh = stand_in(name)
    kept = reduced_hull(np.asarray(mesh.vertices))
    assert len(kept) <= 64
    lost = trimesh.proximity.signed_distance(hull_mesh(kept), mesh.convex_hull.vertices).min()
    assert lost > -0.001


@pytest.mark.parametrize("count", [8, 16, 64])
def test_a_reduced_hull_is_made_of_the_points_and_within_the_limit(count):
    points = np.random.default_rng(1).normal(size=(400, 3))
    kept = reduced_hull(points, count)
    assert len(kept) == min(count, len(trimesh.convex.convex_hull(points).vertices))
    assert all((points == v).all(axis=1).any() for v in kept)


def test_more_vertices_never_lose_more():
    points = trimesh.creation.icosphere(subdivisions=3, radius=0.04).vertices
    volumes = [hull_mesh(reduced_hull(points, n)).volume for n in (8, 16, 32, 64, 1000)]
    assert volumes == sorted(volumes)
    assert volumes[-1] == pytest.approx(trimesh.convex.convex_hull(points).volume)


def test_points_in_a_plane_span_no_hull():
    flat = np.random.default_rng(2).normal(size=(30, 3)) * (1.0, 1.0, 0.0)
    with pytest.raises(ValueError, match="no volume"):
        reduced_hull(flat)


def test_a_hull_mesh_is_closed_and_outward():
    mesh = hull_mesh(np.random.default_rng(3).normal(size=(50, 3)))
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


# Pieces


@pytest.mark.parametrize("name", ["apple", "golf_ball", "mini_soccer_ball"])
def test_a_ball_becomes_its_sphere(name):
    mesh = stand_in(name)
    (piece,), error = convex_pieces(mesh, FEW)
    assert piece.kind == "sphere" and piece.vertices.shape == (0, 3)
    assert piece.radius == pytest.approx(mesh.extents.max() / 2, rel=0.005)
    np.testing.assert_allclose(piece.pos, 0.0, atol=1e-4)
    assert error < 0.0005


def test_a_ball_beside_the_origin_becomes_a_sphere_there():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    mesh.apply_translation((0.2, -0.1, 0.05))
    (piece,), _ = convex_pieces(mesh, FEW)
    assert piece.kind == "sphere"
    np.testing.assert_allclose(piece.pos, (0.2, -0.1, 0.05), atol=1e-4)


def test_an_ellipsoid_and_half_a_ball_are_no_spheres():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    longer = trimesh.Trimesh(ball.vertices * (1.0, 1.0, 1.25), ball.faces, process=False)
    half = hull_mesh(np.asarray(ball.vertices)[ball.vertices[:, 2] > 0])
    for mesh in (longer, half):
        (piece,), _ = convex_pieces(mesh, FEW)
        assert piece.kind == "hull"


def test_a_convex_body_is_one_hull(divided):
    for name in ("foam_brick", "tomato_soup_can"):
        _, pieces, error = divided(name)
        assert len(pieces) == 1 and pieces[0].kind == "hull"
        assert error < 0.0001  # a hull of the mesh's own points lies inside a convex mesh


@pytest.mark.long
def test_a_mug_is_several_pieces_and_stays_open(divided):
    mesh, pieces, _ = divided("mug")
    assert 1 < len(pieces) <= 12
    opening = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))[None] / 2
    # The cup's axis: the middle of the bottom's points, for the handle moves the box's middle.
    bottom = mesh.vertices[mesh.vertices[:, 2] < mesh.bounds[0, 2] + 1e-6]
    opening[0, :2] = (bottom.min(axis=0) + bottom.max(axis=0))[:2] / 2
    opening[0, 2] = mesh.bounds[1, 2] - 0.02
    assert not any(piece.contains(opening)[0] for piece in pieces)


def row_of_boxes(count, gap=0.05):
    """Cubes of 10 mm along x, and the corners of each."""
    cubes = [trimesh.creation.box(extents=(0.01,) * 3) for _ in range(count)]
    for k, cube in enumerate(cubes):
        cube.apply_translation((k * gap, 0.0, 0.0))
    return trimesh.util.concatenate(cubes), [np.asarray(cube.vertices) for cube in cubes]


def test_components_within_the_limit_keep_their_own_hulls():
    mesh, cubes = row_of_boxes(12)
    pieces, error = convex_pieces(mesh, FEW)
    assert [len(piece.vertices) for piece in pieces] == [8] * 12 and error < 1e-6
    for piece, corners in zip(pieces, cubes, strict=True):
        np.testing.assert_allclose(piece.pos, corners.mean(axis=0), atol=1e-9)


def test_twenty_components_share_twelve_pieces():
    mesh, cubes = row_of_boxes(20)
    pieces, _ = convex_pieces(mesh, FEW)
    assert len(pieces) == 12
    held = np.array([[piece.contains(c, 1e-9).all() for piece in pieces] for c in cubes])
    np.testing.assert_array_equal(held.sum(axis=1), 1)  # every cube in one piece, whole
    for piece, members in zip(pieces, held.T, strict=True):
        cells = np.flatnonzero(members)
        np.testing.assert_array_equal(cells, np.arange(cells[0], cells[-1] + 1))  # neighbours
        corners = np.concatenate([cubes[k] for k in cells])
        assert piece.surface().volume == pytest.approx(trimesh.convex.convex_hull(corners).volume)


def test_what_stands_on_a_body_is_not_gathered_across_it():
    """The studs of a tray are nearer to it than to each other, whatever its middle is."""
    tray = trimesh.creation.box(extents=(0.2, 0.15, 0.01))
    studs = [
        trimesh.creation.cylinder(radius=0.004, height=0.005).apply_translation((x, y, 0.0075))
        for x in np.linspace(-0.09, 0.09, 8)
        for y in np.linspace(-0.06, 0.06, 6)
    ]
    parts = convex._gathered([tray, *studs], 12)
    assert len(parts) == 12
    own = sum(part.volume for part in (tray, *studs))
    assert sum(part.convex_hull.volume for part in parts) < 1.1 * own


def test_a_large_component_stays_alone_while_small_ones_are_gathered():
    small, _ = row_of_boxes(14)
    large = trimesh.creation.box(extents=(0.3, 0.3, 0.3))
    large.apply_translation((0.3, 0.0, 0.2))
    pieces, _ = convex_pieces(trimesh.util.concatenate([small, large]), FEW)
    assert len(pieces) == 12
    assert max(piece.surface().volume for piece in pieces) == pytest.approx(0.027, rel=1e-6)


def test_shares_of_concave_components_keep_the_limit():
    rings = [trimesh.creation.annulus(r / 2, r, 0.02, sections=16) for r in (0.10, 0.03, 0.03)]
    for k, ring in enumerate(rings):
        ring.apply_translation((0.2 * k, 0.0, 0.0))
    # By area the shares are 3, 1 and 1: one too many.
    pieces, _ = convex_pieces(
        trimesh.util.concatenate(rings),
        ConvexConfig(samples=300, divisions=(Division(max_pieces=4),)),
    )
    assert len(pieces) == 4
    assert sum(piece.pos[0] < 0.15 for piece in pieces) == 2


@pytest.mark.long
def test_what_stands_out_too_far_is_divided_more_finely():
    ring = trimesh.creation.annulus(0.05, 0.053, 0.02, sections=48)
    few, many = Division(max_pieces=6), Division(max_pieces=12, threshold=0.05)

    def made(*divisions, bound=0.006):
        config = ConvexConfig(samples=300, single_hull_error=bound, divisions=divisions)
        pieces, error = convex_pieces(ring, config)
        return len(pieces), error

    coarse, fine = made(few), made(many)
    assert coarse[0] == 6 and fine[0] == 12 and fine[1] < 0.006 < coarse[1]
    assert made(few, many) == fine
    assert made(few, many, bound=1.1 * coarse[1]) == coarse, "no more than are needed"
    assert made(many, few, bound=0.1 * fine[1]) == fine, "of those that fall short the better"


@pytest.mark.parametrize("name", NAMES)
def test_pieces_keep_the_limits_and_are_solid(divided, name):
    _, pieces, _ = divided(name)
    assert len(pieces) <= 12
    for piece in pieces:
        assert 4 <= len(piece.vertices) <= 64
        surface = piece.surface()
        assert surface.is_watertight and surface.volume > 0
        np.testing.assert_allclose(piece.pos, piece.vertices.mean(axis=0))
        np.testing.assert_array_equal(piece.contains(piece.vertices, 1e-9), True)


@pytest.mark.parametrize("name", NAMES)
def test_pieces_cover_the_surface(divided, name):
    mesh, pieces, _ = divided(name)
    points, _ = trimesh.sample.sample_surface(mesh, 1000, seed=0)
    away = np.min([distance(piece, points) for piece in pieces], axis=0)
    assert (away < 0.006).mean() >= 0.98


@pytest.mark.parametrize("name", NAMES)
def test_the_outward_error_agrees_with_trimesh(divided, name):
    mesh, pieces, error = divided(name)
    share = [piece.surface().area for piece in pieces]
    points = []
    for k, piece in enumerate(pieces):
        count = round(1500 * share[k] / sum(share))
        sample, _ = trimesh.sample.sample_surface(piece.surface(), count, seed=k)
        others = [other.contains(sample, -1e-6) for j, other in enumerate(pieces) if j != k]
        points.append(sample[~np.any(others, axis=0)] if others else sample)
    points = np.concatenate(points)
    away = trimesh.proximity.closest_point(mesh, points)[1]
    away[inside_union(mesh, points)] = 0.0
    assert np.percentile(away, 95) == pytest.approx(error, abs=0.0005)


def test_the_outward_error_of_a_piece_that_sticks_out_is_how_far():
    box = trimesh.creation.box(extents=(0.06, 0.06, 0.06))
    ball = Piece("sphere", np.zeros(3), 0.08)
    points = trimesh.creation.icosphere(subdivisions=5, radius=0.08).vertices
    outside = np.linalg.norm(points - np.clip(points, -0.03, 0.03), axis=1)
    found = outward_error(box, (ball,), FEW)
    assert found == pytest.approx(np.percentile(outside, 95), abs=0.0005)


@pytest.mark.parametrize(
    ("name", "error", "digest"),
    [
        ("foam_brick", 0.0, "bda61783cae5"),
        ("tomato_soup_can", 0.0, "720975b837b8"),
        ("bleach_cleanser", 0.003923665839, "7197db6fd83b"),
        ("tennis_ball", 0.0, "974b36d9453c"),
    ],
)
def test_pieces_stay_what_they_are(name, error, digest):
    # Poses of start states in files rest on them.
    pieces, found = convex_pieces(stand_in(name))
    content = hashlib.sha256()
    for piece in pieces:
        for values in (piece.pos, piece.vertices, np.array([piece.radius])):
            content.update(np.round(1e6 * values).astype(np.int64).tobytes())
    assert found == pytest.approx(error, abs=1e-9)
    assert content.hexdigest()[:12] == digest


@pytest.mark.long
def test_a_looser_bound_takes_one_hull(divided):
    pieces, error = convex_pieces(divided("mug")[0], ConvexConfig(samples=300, single_hull_error=1))
    assert len(pieces) == 1 and error > divided("mug")[2]


def test_contains_grows_with_the_tolerance():
    box = trimesh.creation.box(extents=(0.06, 0.06, 0.06))
    hull = Piece("hull", np.zeros(3), 0.0, np.asarray(box.vertices))
    ball = Piece("sphere", np.zeros(3), 0.03)
    point = np.array([[0.031, 0.0, 0.0]])
    for piece in (hull, ball):
        assert not piece.contains(point)[0]
        assert piece.contains(point, 0.0011)[0]
        assert not piece.contains(point, 0.0009)[0]
