import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.candidates import from_heatmap
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import steer, steer_contacts, steer_many, steer_near, steer_to

SPAN, FRICTION = (0.02, 0.09), 0.5
TERMS = {"width", "thumb", "wrap", "coherence", "com", "separation"}


def heatmap_of_mesh(mesh, config=None, span=SPAN, com=None):
    return compute_heatmap(mesh.vertices, mesh.faces, com, span, FRICTION, config)


def box(extents, edge=0.012):
    return trimesh.creation.box(extents=extents).subdivide_to_size(edge)


def cylinder(radius, height, sections=32, rings=17):
    """A tube of regular rings with closed ends."""
    around = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    z = np.linspace(-height / 2, height / 2, rings)
    ring = np.stack([radius * np.cos(around), radius * np.sin(around)], axis=1)
    wall = np.concatenate([np.column_stack([ring, np.full(sections, h)]) for h in z])
    ends = [[0, 0, z[0]], [0, 0, z[-1]]]
    faces = []
    for r in range(rings - 1):
        for s in range(sections):
            a, b = r * sections + s, r * sections + (s + 1) % sections
            faces += [[a, b, a + sections], [b, b + sections, a + sections]]
    low, high, last = len(wall), len(wall) + 1, (rings - 1) * sections
    for s in range(sections):
        n = (s + 1) % sections
        faces += [[low, n, s], [high, last + s, last + n]]
    return trimesh.Trimesh(np.concatenate([wall, ends]), faces, process=False)


def lump():
    """Without symmetry, so that no tie and no two equal inertias hang on rounding."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    v = mesh.vertices * [1.0, 0.8, 1.7]
    mesh.vertices = v + 0.004 * np.sin(60 * v[:, [1, 2, 0]] + [0.3, 1.1, 2.0])
    return mesh


@pytest.fixture(scope="module")
def lump_map():
    return heatmap_of_mesh(lump())


def all_finite(heatmap):
    return all(np.isfinite(np.asarray(leaf, float)).all() for leaf in jax.tree.leaves(heatmap))


@pytest.mark.parametrize("seed", range(3))
def test_rigid_motion_moves_the_triples_and_leaves_the_scores(lump_map, seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    shift = np.array([0.6, -1.2, 3.0])
    mesh = lump()
    mesh.vertices = mesh.vertices @ turn.T + shift
    moved = heatmap_of_mesh(mesh)
    same = np.abs(np.asarray(moved.score) - lump_map.score) < 2e-3
    expected = np.asarray(lump_map.wrap) @ turn.T + shift
    # The sign of the long axis means nothing, so the wrap pair may come in the other order.
    gap = np.minimum(
        np.abs(moved.wrap - expected).max(axis=(1, 2)),
        np.abs(np.asarray(moved.wrap)[:, ::-1] - expected).max(axis=(1, 2)),
    )
    assert np.mean(same & (gap < 1e-4)) > 0.98
    assert np.allclose(moved.normals, np.asarray(lump_map.normals) @ turn.T, atol=1e-4)


def test_scaling_mesh_and_lengths_together_leaves_the_scores(lump_map):
    k, default = 7.0, HeatmapConfig()
    config = HeatmapConfig(
        wrap_offsets=tuple(k * h for h in default.wrap_offsets),
        curvature_radius=k * default.curvature_radius,
        narrow_sigma=k * default.narrow_sigma,
        width_sigma=k * default.width_sigma,
        com_sigma=k * default.com_sigma,
        full_separation=k * default.full_separation,
    )
    mesh = lump()
    mesh.vertices = mesh.vertices * k
    scaled = heatmap_of_mesh(mesh, config, (k * SPAN[0], k * SPAN[1]))
    assert np.mean(np.abs(np.asarray(scaled.score) - lump_map.score) < 2e-3) > 0.98


def test_a_thin_box_is_best_on_its_broad_faces_near_the_middle():
    heatmap = heatmap_of_mesh(box([0.14, 0.04, 0.16], 0.016))
    best = np.argsort(-np.asarray(heatmap.score))[:14]
    assert heatmap.score[best].min() > 0.8
    assert np.abs(heatmap.normals[best, 1]).min() > 0.99
    assert np.linalg.norm(heatmap.vertices[best][:, [0, 2]], axis=1).max() < 0.02
    assert np.allclose(heatmap.width[best], 0.04, atol=1e-4)
    # The wrap pair lies along z, the longest axis, on the opposite face.
    assert np.allclose(heatmap.wrap[best, :, 1], -heatmap.vertices[best, None, 1], atol=1e-5)
    spread = np.asarray(heatmap.wrap[best, 0] - heatmap.wrap[best, 1])
    assert np.all(np.abs(spread[:, 2]) > 0.99 * np.linalg.norm(spread, axis=1))


def test_equal_scores_keep_the_smallest_offset_that_reaches_them():
    heatmap = heatmap_of_mesh(box([0.14, 0.04, 0.16], 0.016))
    middle = np.argmax(heatmap.score)
    # 10 mm to each side is only 20 mm apart; from 15 mm on the separation is full.
    assert heatmap.offset[middle] == pytest.approx(0.015)


def test_a_cylinder_is_wrapped_lengthwise():
    heatmap = heatmap_of_mesh(cylinder(0.03, 0.12))
    good = np.flatnonzero(np.asarray(heatmap.score) > 0.5)
    assert len(good) > 50
    spread = np.asarray(heatmap.wrap[good, 0] - heatmap.wrap[good, 1])
    assert np.all(np.abs(spread[:, 2]) > 0.97 * np.linalg.norm(spread, axis=1))
    assert np.allclose(heatmap.width[good], 0.06, atol=2e-3)


def test_a_sphere_wider_than_the_span_scores_near_zero_and_a_small_one_does_not():
    large = heatmap_of_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.06))
    small = heatmap_of_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.04))
    assert np.max(large.score) < 1e-3
    # Half a sphere's 44° between the wrap normals costs it most of its coherence, not all.
    assert np.median(small.score) > 0.05


def test_the_terms_multiply_to_the_score(lump_map):
    terms = {name: np.asarray(value, np.float64) for name, value in lump_map.terms.items()}
    assert set(terms) == TERMS
    product = np.prod([terms[name] for name in sorted(TERMS)], axis=0)
    assert np.allclose(product, lump_map.score, rtol=1e-4, atol=1e-9)
    assert np.allclose(np.asarray(lump_map.score_without_com) * terms["com"], lump_map.score)
    assert all(np.all((t >= 0) & (t <= 1 + 1e-6)) for t in terms.values())


def test_every_reported_geometry_agrees_with_the_others(lump_map):
    h = jax.tree.map(np.asarray, lump_map)
    assert np.allclose(h.centre, h.wrap.mean(axis=1), atol=1e-6)
    assert np.allclose(h.thumb + h.width[:, None] * h.axis, h.centre, atol=1e-6)
    assert np.allclose(np.linalg.norm(h.axis, axis=1), 1, atol=1e-5)
    assert np.allclose(np.linalg.norm(h.wrap_normals, axis=2), 1, atol=1e-5)
    distance = np.abs(trimesh.proximity.closest_point_naive(lump(), h.wrap[:200].reshape(-1, 3))[1])
    assert distance.max() < 1e-6


def test_friction_cone_edge_scores_e_to_the_minus_four():
    # Two skew plates: the width axis leans by exactly arctan μ at the wrap side.
    from mjx_grasp.heatmap.scores import friction_score

    lean = np.arctan(FRICTION)
    force = jnp.float32([np.sin(lean), 0, np.cos(lean)])
    score = friction_score(force, jnp.float32([0, 0, 1]), jnp.float32(FRICTION), 0.5)
    assert score == pytest.approx(np.exp(-4), rel=1e-4)


@pytest.mark.wrong_types
def test_contacts_are_steered_to_one_point_or_box(lump_map):
    for given, text in (
        ((np.zeros((2, 3)),), r"anchor: found 'shape \(2, 3\)', expected three numbers"),
        ((np.zeros(3), np.zeros(2)), r"size: found 'shape \(2,\)', expected three numbers"),
    ):
        with pytest.raises(InputError, match=text):
            steer_contacts(lump_map, *given)


@pytest.mark.wrong_types
def test_candidates_have_one_score_each(lump_map):
    v = len(lump_map.score)
    with pytest.raises(InputError, match=rf"score: found 'shape \({v - 1},\)', expected one of"):
        from_heatmap(lump_map, lump_map.score[1:])


@pytest.mark.wrong_types
def test_anchors_that_are_no_points_are_refused(lump_map):
    with pytest.raises(InputError, match=r"anchor: found 'shape \(2, 3\)', expected one point"):
        steer(lump_map, np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"anchors: found 'shape \(3,\)', expected points"):
        steer_many(lump_map, np.zeros(3))
    for wrong in (np.zeros((2, 3)), np.zeros(2), 0.0):
        with pytest.raises(InputError, match=r"anchor: found 'shape .*expected one point"):
            steer_near(lump_map, wrong)


ONE_ANCHOR = {
    "axis": steer,
    "between": steer_near,
    "contacts": lambda heatmap, anchor, sigma: steer_contacts(heatmap, anchor, None, sigma),
    "to": lambda heatmap, anchor, sigma: steer_to(heatmap, anchor, sigma=sigma),
    "many": lambda heatmap, anchor, sigma: steer_many(heatmap, anchor[None], sigma),
}


@pytest.mark.parametrize("way", ONE_ANCHOR.values(), ids=ONE_ANCHOR.keys())
def test_anchors_and_widths_without_a_score_are_refused(lump_map, way):
    anchor = np.zeros(3, np.float32)
    for value in (np.nan, np.inf):
        with pytest.raises(
            InputError, match=r"anchors?: found .*(nan|inf).*expected finite numbers"
        ):
            way(lump_map, np.float32([0, value, 0]), 0.03)
    for sigma in (0.0, -0.01, np.nan):
        with pytest.raises(InputError, match=r"sigma: found .* expected more than 0 m"):
            way(lump_map, anchor, sigma)
    with pytest.raises(InputError, match=r"size: found .*nan"):
        steer_contacts(lump_map, anchor, np.float32([np.nan, 0, 0]))


@pytest.mark.parametrize("way", ONE_ANCHOR.values(), ids=ONE_ANCHOR.keys())
def test_where_values_are_traced_nothing_is_refused(lump_map, way):
    anchors = np.float32([[0.01, 0.0, 0.02], [np.nan, 0.0, 0.0]])
    sigmas = np.float32([0.03, 0.0])
    expected = way(lump_map, anchors[0], sigmas[0])
    batched = jax.vmap(lambda a, s: way(lump_map, a, s))
    for found in (
        jax.jit(lambda a, s: way(lump_map, a, s))(anchors[0], sigmas[0]),
        batched(jnp.asarray(anchors), jnp.asarray(sigmas))[0],
        jax.jit(batched)(anchors, sigmas)[0],
        jax.jit(lambda s: way(lump_map, anchors[0], s))(sigmas[0]),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)
    slope = jax.jacfwd(lambda a: way(lump_map, a, 0.03).sum())(anchors[0])
    assert np.isfinite(slope).all()


@pytest.mark.wrong_types
def test_there_is_one_width_or_one_of_each_anchor(lump_map):
    for way in (steer, steer_near):
        with pytest.raises(InputError, match=r"sigma: found 'shape \(2,\)', expected one number"):
            way(lump_map, np.zeros(3), np.full(2, 0.03))
    with pytest.raises(InputError, match=r"sigma: found 'shape \(2,\)', expected one number, or"):
        steer_many(lump_map, np.zeros((3, 3)), np.full(2, 0.03))


@pytest.mark.wrong_types
def test_anchors_may_be_lists(lump_map):
    anchor, size = [0.01, 0.0, 0.02], [0.02, 0.02, 0.02]
    for way in (steer, steer_near, steer_contacts):
        np.testing.assert_array_equal(way(lump_map, anchor), way(lump_map, np.float32(anchor)))
    found = steer_contacts(lump_map, anchor, size)
    np.testing.assert_array_equal(
        found, steer_contacts(lump_map, np.float32(anchor), np.float32(size))
    )


def test_steering_to_the_centre_of_mass_gives_the_default_bit_for_bit(lump_map):
    from mjx_grasp.geometry.mesh import principal_frame

    mesh = lump()
    com = principal_frame(mesh.vertices, mesh.faces).centre
    assert np.array_equal(steer(lump_map, com, HeatmapConfig().com_sigma), lump_map.score)
    other = np.array([0.01, 0.0, 0.02])
    explicit = heatmap_of_mesh(mesh, com=other)
    assert np.array_equal(steer(explicit, other, 0.030), explicit.score)
    assert not np.array_equal(explicit.score, lump_map.score)


def test_steering_follows_the_anchor_and_never_divides():
    # With σ = 5 mm the default score underflows 13 cm from the centre of mass; the anchor there
    # must still find its candidates.
    config = HeatmapConfig(com_sigma=0.005)
    heatmap = jax.tree.map(np.asarray, heatmap_of_mesh(box([0.1, 0.04, 0.3], 0.025), config))
    anchor = np.array([0.0, 0.0, 0.13])
    assert heatmap.score[heatmap.vertices[:, 2] > 0.12].max() == 0
    steered = np.asarray(steer(heatmap, anchor, 0.020))
    best = np.argmax(steered)
    assert steered[best] > 0.2
    assert np.linalg.norm(heatmap.vertices[best][[0, 2]] - anchor[[0, 2]]) < 0.020
    anchors = np.stack([anchor, -anchor, np.zeros(3)])
    many = jax.vmap(lambda a: steer(heatmap, a, 0.020))(np.float32(anchors))
    for row, one in zip(many, anchors, strict=True):
        assert np.allclose(row, steer(heatmap, one, 0.020), atol=1e-6)


def duplicated_soup():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    soup = mesh.triangles.reshape(-1, 3)
    return trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False)


def with_degenerate_faces():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    bad = np.array([[0, 0, 1], [2, 2, 2], [3, 4, 3]])
    loose = np.concatenate([mesh.vertices, mesh.vertices[:1], [[0.5, 0.5, 0.5]]])
    more = np.concatenate([mesh.faces, bad, [[0, len(mesh.vertices), 5]]])
    return trimesh.Trimesh(loose, more, process=False)


def one_triangle():
    corners = [[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2]], process=False)


def no_extent():
    return trimesh.Trimesh(np.zeros((4, 3)), [[0, 1, 2], [1, 2, 3]], process=False)


@pytest.mark.parametrize(
    "make",
    [duplicated_soup, with_degenerate_faces, one_triangle, no_extent],
    ids=lambda f: f.__name__,
)
def test_never_nan(make):
    mesh = make()
    heatmap = heatmap_of_mesh(mesh)
    assert all_finite(heatmap)
    invalid = ~np.asarray(heatmap.valid)
    assert np.all(np.asarray(heatmap.score)[invalid] == 0)
    assert np.all(np.asarray(heatmap.score_without_com)[invalid] == 0)
    assert len(heatmap.score) == len(mesh.vertices)
    if make in (one_triangle, no_extent):
        assert invalid.all()


def test_degenerate_faces_do_not_disturb_the_rest():
    clean = heatmap_of_mesh(
        trimesh.creation.icosphere(subdivisions=2, radius=0.03), com=np.zeros(3)
    )
    dirty = heatmap_of_mesh(with_degenerate_faces(), com=np.zeros(3))
    untouched = slice(6, len(clean.score))
    assert np.mean(np.abs(dirty.score[untouched] - clean.score[untouched]) < 1e-3) > 0.95


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"vertices": np.full((3, 3), np.nan)}, "vertices"),
        ({"faces": np.array([[0, 1, 99]])}, "faces"),
        ({"faces": np.zeros((0, 3), int)}, "faces"),
        ({"span": (0.09, 0.02)}, "span"),
        ({"scoring_friction": 0.0}, "scoring_friction"),
    ],
)
def test_bad_input_is_refused_by_name(change, field):
    mesh = one_triangle()
    good = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "com": None,
        "span": SPAN,
        "scoring_friction": FRICTION,
    }
    with pytest.raises(InputError) as error:
        compute_heatmap(**(good | change))
    assert error.value.field == field


def test_bad_settings_are_refused_by_name():
    with pytest.raises(InputError, match="wrap_offsets"):
        HeatmapConfig(wrap_offsets=(0.02, 0.01))
    with pytest.raises(InputError, match="com_sigma"):
        HeatmapConfig(com_sigma=0.0)
