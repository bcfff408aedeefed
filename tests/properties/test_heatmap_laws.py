"""The laws of method §1 ("must hold"), on random shapes and motions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjx_grasp.heatmap import scores as terms
from mjx_grasp.heatmap.compute import compute_heatmap, compute_heatmaps
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import steer, steer_many, weigh

SPAN, FRICTION = (0.02, 0.09), 0.5
seeds = st.integers(0, 10_000)
few = settings(max_examples=8)
BACKENDS = ["bvh", pytest.param("brute", marks=pytest.mark.long)]


def heatmap_of_mesh(mesh, config=None, span=SPAN, com=None):
    return compute_heatmap(np.asarray(mesh.vertices), np.asarray(mesh.faces), com, span, FRICTION,
                           config)  # fmt: skip


@functools.cache
def lump(seed):
    """Without symmetry: no decision hangs on a tie. Of one size: it compiles once."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    v = mesh.vertices * rng.uniform([0.9, 0.7, 1.4], [1.1, 0.85, 1.9])
    mesh.vertices = v + 0.003 * np.sin(60 * v[:, [1, 2, 0]] + rng.uniform(0, 6, 3))
    return mesh


@functools.cache
def lump_map(seed):
    return jax.tree.map(np.asarray, heatmap_of_mesh(lump(seed)))


def changed(mesh, vertices):
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


@few
@given(seeds, st.integers(0, 3), st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_rigid_motion_moves_the_triples_and_leaves_the_scores(seed, which, shift):
    still = lump_map(which)
    R = Rotation.random(random_state=seed).as_matrix()
    moved = heatmap_of_mesh(changed(lump(which), lump(which).vertices @ R.T + shift))
    same = np.abs(np.asarray(moved.score) - still.score) < 1e-4
    expected = still.wrap @ R.T + shift
    # The sign of the long axis means nothing: the pair may come in the other order.
    gap = np.minimum(
        np.abs(moved.wrap - expected).max(axis=(1, 2)),
        np.abs(np.asarray(moved.wrap)[:, ::-1] - expected).max(axis=(1, 2)),
    )
    # Shifted by metres, float32 keeps a quarter of a micrometre.
    assert np.mean(same) >= 0.995
    assert np.mean(gap < 2e-6) >= 0.99
    assert np.mean(np.abs(moved.axis - still.axis @ R.T).max(axis=1) < 1e-4) >= 0.99


@few
@given(st.floats(0.01, 100.0), st.integers(0, 3))
def test_scaling_mesh_and_lengths_together_scales_the_triples(k, which):
    still, default = lump_map(which), HeatmapConfig()
    # Scaled in float32, as the settings are compared with positions in it.
    config = HeatmapConfig(
        wrap_offsets=tuple(k * h for h in default.wrap_offsets),
        curvature_radius=k * default.curvature_radius,
        narrow_sigma=k * default.narrow_sigma,
        width_sigma=k * default.width_sigma,
        com_sigma=k * default.com_sigma,
        full_separation=k * default.full_separation,
    )
    mesh = changed(lump(which), lump(which).vertices * k)
    scaled = heatmap_of_mesh(mesh, config, (k * SPAN[0], k * SPAN[1]))
    assert np.mean(np.abs(np.asarray(scaled.score) - still.score) < 1e-4) >= 0.995
    assert np.mean(np.abs(scaled.width - k * still.width) < 1e-5 * k) >= 0.995


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_same_mesh_gives_the_same_bits(backend):
    config = HeatmapConfig(backend=backend)
    first, again = heatmap_of_mesh(lump(0), config), heatmap_of_mesh(lump(0), config)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        assert np.array_equal(a, b)


def mirrored_box():
    """A box whose triangles are mirrored in x = 0 and y = 0 and z = 0, as its corners are."""
    octant = trimesh.creation.box([0.03, 0.02, 0.05]).subdivide_to_size(0.012)
    octant.apply_translation([0.015, 0.01, 0.025])
    outside = (octant.triangles_center > 1e-9).all(axis=1)
    octant.update_faces(outside)
    parts = []
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).T.reshape(-1, 3):
        faces = octant.faces if signs.prod() > 0 else octant.faces[:, ::-1]
        parts.append(trimesh.Trimesh(octant.vertices * signs, faces, process=False))
    return trimesh.util.concatenate(parts).process()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_symmetric_object_has_symmetric_scores(axis):
    mesh = mirrored_box()
    mesh.merge_vertices()
    heatmap = heatmap_of_mesh(mesh)
    mirror = np.ones(3)
    mirror[axis] = -1
    image = mesh.vertices * mirror
    partner = np.argmin(np.linalg.norm(mesh.vertices[:, None] - image, axis=2), axis=0)
    assert np.linalg.norm(mesh.vertices[partner] - image, axis=1).max() < 1e-9
    score = np.asarray(heatmap.score)
    assert score.max() > 0.5
    assert np.abs(score - score[partner]).max() < 1e-4


unit_angles = st.floats(0.0, np.pi)


@given(unit_angles, unit_angles)
def test_angle_terms_fall_with_the_angle(a, b):
    a, b = sorted((a, b))
    up = jnp.float32([0, 0, 1])
    tilted = [jnp.float32([np.sin(x), 0, np.cos(x)]) for x in (a, b)]
    for score in (
        lambda n: terms.friction_score(n, up, jnp.float32(FRICTION), 0.5),
        lambda n: terms.coherence_score(n, up, 0.5),
    ):
        near, far = (float(score(n)) for n in tilted)
        assert 0 <= far <= near + 1e-6 <= 1 + 2e-6


lengths = st.floats(0.0, 0.3)


@given(lengths, lengths)
def test_length_terms_are_monotone(a, b):
    a, b = sorted((np.float32(a), np.float32(b)))
    zero, x, z = jnp.float32([[0, 0, 0], [1, 0, 0], [0, 0, 1]])

    def width(w):
        return float(terms.width_score(jnp.asarray(w), jnp.float32(SPAN), 0.025, 0.01))

    # Rises up to the span, 1 on it, falls beyond it.
    if b <= SPAN[0]:
        assert width(a) <= width(b)
    if a >= SPAN[1]:
        assert width(a) >= width(b)
    if a >= 0.0201 and b <= 0.0899:
        assert width(a) == width(b) == 1
    assert terms.separation_score(zero, a * x, 0.03) <= terms.separation_score(zero, b * x, 0.03)
    assert terms.anchor_score(a * x, zero, z, 0.03) >= terms.anchor_score(b * x, zero, z, 0.03)


@st.composite
def broken_meshes(draw):
    """Lumps with loose, repeated and flat faces, holes, doubled vertices, several components."""
    rng = np.random.default_rng(draw(seeds))
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if draw(st.booleans()):  # several components, one inside another
        v = np.concatenate([v, 0.5 * v, v + np.array([0.1, 0.02, 0.0])])
        f = np.concatenate([f, f + len(mesh.vertices), f + 2 * len(mesh.vertices)])
    if draw(st.booleans()):  # open
        f = f[v[f].mean(axis=1)[:, 2] < 0.01]
    if draw(st.booleans()):  # doubled vertices
        f = np.concatenate([f, f[:3] + 0])
        v, f = v[f].reshape(-1, 3), np.arange(3 * len(f)).reshape(-1, 3)
    if draw(st.booleans()):  # faces without area, and faces that use a vertex nobody else uses
        flat = rng.integers(0, len(v), (20, 3))
        flat[:, 2] = flat[:, draw(st.integers(0, 1))]
        f = np.concatenate([f, flat, [[0, 1, len(v)]]])
        v = np.concatenate([v, rng.normal(0, draw(st.sampled_from([1e-30, 0.02, 1.0])), (1, 3))])
    return v, f


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=15)
@given(mesh=broken_meshes())
def test_nothing_is_ever_nan_and_scores_stay_within_0_and_1(backend, mesh):
    v, f = mesh
    heatmap = compute_heatmap(v, f, None, SPAN, FRICTION, HeatmapConfig(backend=backend))
    for leaf in jax.tree.leaves(heatmap):
        assert np.isfinite(np.asarray(leaf, float)).all()
    score = np.asarray(heatmap.score)
    assert len(score) == len(v)
    assert score.min() >= 0 and score.max() <= 1 + 1e-6
    assert np.all(score[~np.asarray(heatmap.valid)] == 0)


@few
@given(st.integers(0, 3), st.tuples(*[st.floats(-0.05, 0.05)] * 3))
def test_the_default_anchor_gives_the_default_heatmap_bit_for_bit(which, com):
    com = np.array(com)
    heatmap = heatmap_of_mesh(lump(which), com=com)
    assert np.array_equal(steer(heatmap, com, HeatmapConfig().com_sigma), heatmap.score)


def test_thousands_of_anchors_equal_the_loop():
    heatmap = heatmap_of_mesh(lump(0))
    anchors = np.random.default_rng(0).normal(0, 0.03, (2000, 3)).astype(np.float32)
    sigmas = np.linspace(0.005, 0.05, len(anchors), dtype=np.float32)
    many = np.asarray(steer_many(heatmap, anchors, sigmas))
    assert many.shape == (2000, len(heatmap.score))
    for k in range(0, 2000, 7):
        assert np.allclose(many[k], steer(heatmap, anchors[k], sigmas[k]), rtol=1e-5, atol=1e-7)
    by_vmap = jax.vmap(lambda a, s: steer(heatmap, a, s))(anchors, sigmas)
    assert np.allclose(many, by_vmap, rtol=1e-5, atol=1e-7)


def test_a_moving_anchor_compiles_nothing():
    heatmap = heatmap_of_mesh(lump(0))
    steer(heatmap, np.zeros(3))
    compiled = weigh._cache_size()
    best = []
    for t in np.linspace(0, 1, 200):
        anchor = np.array([0.02 * np.cos(t), 0.02 * np.sin(t), 0.05 * t])
        best.append(int(np.argmax(steer(heatmap, anchor, 0.01 + 0.02 * t))))
    assert weigh._cache_size() == compiled
    assert len(set(best)) > 3


@settings(max_examples=4)
@given(seeds)
def test_many_meshes_at_once_equal_the_loop(seed):
    rng = np.random.default_rng(seed)
    meshes = [
        trimesh.creation.icosphere(subdivisions=n, radius=rng.uniform(0.01, 0.05))
        for n in rng.integers(1, 4, rng.integers(1, 6))
    ]
    arrays = [(m.vertices * rng.uniform(0.6, 1.5, 3), m.faces) for m in meshes]
    together = compute_heatmaps(arrays, None, SPAN, FRICTION)
    for (v, f), heatmap in zip(arrays, together, strict=True):
        alone = compute_heatmap(v, f, None, SPAN, FRICTION)
        for a, b in zip(jax.tree.leaves(heatmap), jax.tree.leaves(alone), strict=True):
            assert np.allclose(a, b, atol=1e-6)
