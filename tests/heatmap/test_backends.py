"""Both backends give the same heatmap, and many meshes at once the same as one by one."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import tiles
from mjx_grasp.heatmap.backends import backend_for
from mjx_grasp.heatmap.compute import compute_heatmap, compute_heatmaps
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.objects.meshes import centred, read_mesh
from mjx_grasp.objects.parametric import stand_in

HAND = ((0.02, 0.09), 0.5)


def by(backend, *meshes, **settings):
    arrays = [(np.asarray(m.vertices), np.asarray(m.faces)) for m in meshes]
    config = HeatmapConfig(backend=backend, **settings)
    return [
        jax.tree.map(np.asarray, h) for h in compute_heatmaps(arrays, None, *HAND, config=config)
    ]


def agreement(a, b):
    """Shares of vertices with the same score and validity, and with the same contacts."""
    score = (np.abs(a.score - b.score) < 1e-4) & (a.valid == b.valid)
    contacts = np.ones(len(score), bool)
    for name in ("opposing", "centre"):
        contacts &= np.linalg.norm(getattr(a, name) - getattr(b, name), axis=1) < 2e-6
    return score.mean(), (contacts | ~a.valid).mean()


@pytest.mark.parametrize("name", ["mug", pytest.param("power_drill", marks=pytest.mark.long)])
def test_backends_agree_on_stand_ins(name):
    (bvh,), (brute,) = by("bvh", stand_in(name)), by("brute", stand_in(name))
    scores, contacts = agreement(bvh, brute)
    # A few seeds of a wall of one thickness are as near to its inside as to its outside.
    assert scores >= 0.999 and contacts >= 0.995


@pytest.mark.long
def test_backends_agree_where_few_faces_are_near():
    # Sparse faces: the neighbourhood has to be widened, and on the box to as many as there are.
    lump = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    lump.vertices *= [1.0, 1.3, 1.8] + 0.1 * np.random.default_rng(0).random((42, 3))
    sparse = [
        trimesh.creation.box([0.06, 0.05, 0.3]),
        trimesh.creation.cylinder(radius=0.03, height=0.2, sections=9),
        lump,
        trimesh.Trimesh([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]], [[0, 1, 2]], process=False),
    ]
    for mesh in sparse:
        mesh.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7))
    for bvh, brute in zip(by("bvh", *sparse), by("brute", *sparse), strict=True):
        across = np.linalg.norm(np.cross(bvh.long_axis, brute.long_axis), axis=1)
        assert np.all((across < 1e-4) | ~bvh.valid)
        assert agreement(bvh, brute) == (1, 1)


@pytest.mark.long
@pytest.mark.skipif("MJX_GRASP_SCANS" not in os.environ, reason="scans may not be committed")
def test_backends_agree_on_every_scan():
    files = sorted(Path(os.environ["MJX_GRASP_SCANS"]).glob("*.obj"))
    meshes = [centred(read_mesh(file)) for file in files]
    for file, bvh, brute in zip(files, by("bvh", *meshes), by("brute", *meshes), strict=True):
        scores, contacts = agreement(bvh, brute)
        assert scores >= 0.999 and contacts >= 0.999, file.name


@pytest.mark.parametrize("backend", ["bvh", pytest.param("brute", marks=pytest.mark.long)])
def test_meshes_of_different_sizes_at_once_equal_one_by_one(backend):
    meshes = [
        trimesh.creation.box([0.04, 0.06, 0.1]),
        trimesh.creation.icosphere(subdivisions=3, radius=0.03),
        trimesh.creation.icosphere(subdivisions=2, radius=0.04),
        trimesh.creation.cylinder(radius=0.02, height=0.1, sections=48),
    ]
    for k, mesh in enumerate(meshes):
        mesh.apply_translation([k, -k, 0.1 * k])
    for mesh, heatmap in zip(meshes, by(backend, *meshes), strict=True):
        (alone,) = by(backend, mesh)
        assert len(heatmap.score) == len(mesh.vertices)
        for a, b in zip(jax.tree.leaves(heatmap), jax.tree.leaves(alone), strict=True):
            assert np.allclose(a, b, atol=1e-5)


def test_given_centres_of_mass_go_to_their_meshes():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    arrays = (np.asarray(mesh.vertices), np.asarray(mesh.faces))
    coms = [np.array([0.01, 0, 0]), None, np.array([0, 0, -0.02])]
    together = compute_heatmaps([arrays] * 3, coms, *HAND)
    for com, heatmap in zip(coms, together, strict=True):
        assert np.array_equal(heatmap.score, compute_heatmap(*arrays, com, *HAND).score)
    with pytest.raises(InputError, match=r"com: found .* expected three finite numbers"):
        compute_heatmaps([arrays], [np.full(3, np.nan)], *HAND)
    with pytest.raises(InputError, match="coms"):
        compute_heatmaps([arrays] * 3, coms[:2], *HAND)


def test_no_meshes_give_no_heatmaps():
    assert compute_heatmaps([], None, *HAND) == []


@pytest.mark.long
def test_the_tile_changes_nothing():
    # Without symmetries: where two contacts are equally good, rounding decides between them.
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    mesh.vertices *= [1.0, 1.3, 1.8] + 0.1 * np.random.default_rng(0).random((162, 3))
    (small,), (large,) = by("brute", mesh, tile=50), by("brute", mesh, tile=10_000)
    for a, b in zip(jax.tree.leaves(small), jax.tree.leaves(large), strict=True):
        assert np.allclose(a, b, atol=1e-5)


def test_tiles_are_smaller_for_larger_meshes_and_never_nothing():
    sizes = [tiles.tile_for(faces) for faces in (10, 1000, 100_000, 10**9)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] >= 1
    assert sizes[1] * 1000 <= 2 * tiles.tile_for(1)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 23])
def test_map_tiles_is_the_function_of_all_rows(n):
    x = jnp.arange(3.0 * n).reshape(n, 3)
    found = tiles.map_tiles(lambda a, b: (a.sum(axis=1), 2 * b), (x, x[:, 0]), 8)
    assert np.allclose(found[0], x.sum(axis=1)) and np.allclose(found[1], 2 * x[:, 0])


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_first_least_is_the_argmin_on_every_platform(platform, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    values = jnp.float32([[3, 1, 1], [np.inf, np.inf, np.inf], [0, 2, 0]])
    assert np.array_equal(tiles.first_least(values), [1, 0, 0])


@pytest.mark.wrong_types
def test_the_backend_can_be_chosen_and_a_wrong_one_is_refused():
    assert backend_for(100, HeatmapConfig(backend="brute")) == "brute"
    assert backend_for(10**6, HeatmapConfig(backend="bvh")) == "bvh"
    assert backend_for(100, HeatmapConfig()) in ("bvh", "brute")
    with pytest.raises(InputError, match="backend"):
        HeatmapConfig(backend="octree")
    with pytest.raises(InputError, match="tile"):
        HeatmapConfig(tile=0)
