"""Loading objects: the cache, the content hash, and scans in the place of stand-ins."""

from functools import partial

import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.objects import kept_pieces
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.convex import ConvexConfig
from mjx_grasp.objects.model import load_object, load_objects

EXTENTS = (0.075, 0.05, 0.052)


@pytest.fixture
def scans(tmp_path):
    """A folder with two scans, each a box of twelve faces beside the origin."""
    folder = tmp_path / "scans"
    folder.mkdir()
    brick = trimesh.creation.box(extents=EXTENTS).apply_translation((0.3, -0.2, 0.1))
    brick.export(folder / "061_foam_brick.obj")
    pitcher = trimesh.creation.box(extents=(0.1, 0.15, 0.24))
    pitcher.export(folder / "019_pitcher_base.ply")
    return folder


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def derivations(monkeypatch):
    """How often convex pieces were worked out."""
    calls = []
    real = kept_pieces.convex_pieces
    monkeypatch.setattr(kept_pieces, "convex_pieces", lambda mesh: calls.append(1) or real(mesh))
    return calls


def assert_same(a, b):
    assert (a.name, a.source, a.mass, a.content_hash) == (b.name, b.source, b.mass, b.content_hash)
    assert a.outward_error_95 == b.outward_error_95
    for x, y in ((a.com, b.com), (a.inertia, b.inertia), (a.mesh.vertices, b.mesh.vertices)):
        np.testing.assert_array_equal(x, y)
    for p, q in zip(a.pieces, b.pieces, strict=True):
        assert (p.kind, p.radius) == (q.kind, q.radius)
        np.testing.assert_array_equal(p.pos, q.pos)
        np.testing.assert_array_equal(p.vertices, q.vertices)
    for r, s in zip(a.resting, b.resting, strict=True):
        assert (r.height, r.probability) == (s.height, s.probability)
        np.testing.assert_array_equal(r.quat, s.quat)


def test_a_scan_is_loaded_in_the_object_frame(scans, cache):
    brick = load_object("foam_brick", scans, cache)
    assert brick.source == "scan" and brick.name == "foam_brick"
    np.testing.assert_allclose(brick.mesh.extents, EXTENTS, atol=1e-6)
    np.testing.assert_allclose(brick.mesh.bounds.sum(axis=0), 0.0, atol=1e-9)
    assert brick.mass == load_catalogue()["foam_brick"].mass
    np.testing.assert_allclose(brick.com, 0.0, atol=1e-7)
    square = np.square(EXTENTS)
    exact = brick.mass / 12 * (square.sum() - square)
    np.testing.assert_allclose(brick.inertia, np.diag(exact), rtol=1e-5, atol=1e-10)
    assert len(brick.pieces) == 1 and len(brick.pieces[0].vertices) == 8
    assert len(brick.resting) == 6
    heights = {round(2 * pose.height, 4) for pose in brick.resting}
    assert heights == set(EXTENTS)


def test_a_cache_hit_equals_the_rebuild(scans, cache, tmp_path, derivations):
    made = load_object("foam_brick", scans, cache)
    hit = load_object("foam_brick", scans, cache)
    assert len(derivations) == 1 and len(list(cache.iterdir())) == 1
    rebuilt = load_object("foam_brick", scans, tmp_path / "another")
    assert len(derivations) == 2
    assert_same(made, hit)
    assert_same(made, rebuilt)


@pytest.mark.parametrize("damage", [b"", b"not an archive", None])
def test_a_damaged_entry_is_made_again(scans, cache, derivations, damage):
    made = load_object("foam_brick", scans, cache)
    (entry,) = cache.iterdir()
    good = entry.read_bytes()
    entry.write_bytes(good[: len(good) // 2] if damage is None else damage)
    again = load_object("foam_brick", scans, cache)
    assert len(derivations) == 2
    assert_same(made, again)
    load_object("foam_brick", scans, cache)
    assert len(derivations) == 2  # the entry was put right


@pytest.mark.parametrize(
    "change",
    [{"_CACHE_FORMAT": -1}, {"ConvexConfig": partial(ConvexConfig, max_vertices=32)}],
    ids=lambda change: next(iter(change)),
)
def test_other_settings_use_another_entry(scans, cache, derivations, monkeypatch, change):
    load_object("foam_brick", scans, cache)
    for name, value in change.items():
        monkeypatch.setattr(kept_pieces, name, value)
    load_object("foam_brick", scans, cache)
    assert len(derivations) == 2 and len(list(cache.iterdir())) == 2


def test_a_ball_survives_the_cache(tmp_path, cache, derivations):
    folder = tmp_path / "balls"
    folder.mkdir()
    trimesh.creation.icosphere(subdivisions=2, radius=0.04).export(folder / "013_apple.obj")
    made, hit = (load_object("apple", folder, cache) for _ in range(2))
    assert len(derivations) == 1 and made.pieces[0].kind == "sphere"
    assert_same(made, hit)


def test_the_content_hash_is_the_shapes(scans, cache, tmp_path):
    brick = load_object("foam_brick", scans, cache)
    moved = tmp_path / "moved"
    moved.mkdir()
    mesh = trimesh.creation.box(extents=EXTENTS).apply_translation((-0.1, 0.4, 0.2))
    mesh.export(moved / "061_foam_brick.obj")
    assert load_object("foam_brick", moved, cache).content_hash == brick.content_hash
    mesh.apply_scale(1.01)
    mesh.export(moved / "061_foam_brick.obj")
    assert load_object("foam_brick", moved, cache).content_hash != brick.content_hash


def test_a_scaled_copy_is_another_shape_of_the_same_scan(scans, cache):
    whole = load_object("pitcher_base", scans, cache)
    small = load_object("pitcher_base_scaled", scans, cache)
    np.testing.assert_allclose(small.mesh.extents, 0.6 * whole.mesh.extents, rtol=1e-9)
    assert small.content_hash != whole.content_hash
    assert small.mass == whole.mass
    np.testing.assert_allclose(small.inertia, 0.36 * whole.inertia, rtol=1e-9, atol=1e-15)


def test_several_objects_in_their_order(scans, cache):
    names = ["pitcher_base", "foam_brick", "pitcher_base_scaled"]
    loaded = load_objects(names, scans, cache)
    assert [o.name for o in loaded] == names
    for each in loaded:
        assert_same(each, load_object(each.name, scans, cache))


def test_pieces_that_stand_out_are_named(scans, cache, monkeypatch, capsys):
    load_objects(["foam_brick"], scans, cache)
    assert "stand out" not in capsys.readouterr().err
    pieces = load_object("foam_brick", scans, cache).pieces
    monkeypatch.setattr(kept_pieces, "convex_pieces", lambda mesh: (pieces, 0.009))
    load_objects(["foam_brick", "pitcher_base"], scans, cache)  # the first from the cache
    said = " ".join(capsys.readouterr().err.split())
    assert "more than 6 mm: pitcher_base (9 mm)" in said and "foam_brick" not in said


def test_an_unknown_name_is_refused(cache):
    with pytest.raises(InputError, match="foam_brik"):
        load_object("foam_brik", cache_dir=cache)
    assert not cache.exists()


def test_a_scan_that_is_missing_or_open_is_refused(scans, cache):
    with pytest.raises(FileError, match="no scan of 025_mug"):
        load_object("mug", scans, cache)
    vertices, faces = trimesh.creation.box(extents=EXTENTS).vertices, [[0, 1, 3], [4, 7, 5]]
    trimesh.Trimesh(vertices, faces, process=False).export(scans / "025_mug.obj")
    with pytest.raises(FileError, match=r"025_mug\.obj.*open beyond repair"):
        load_object("mug", scans, cache)


def test_where_no_pieces_can_be_kept_they_are_worked_out_again(tmp_path, derivations):
    (tmp_path / "file").touch()
    for count in (1, 2):
        assert load_object("foam_brick", cache_dir=tmp_path / "file" / "cache").pieces
        assert len(derivations) == count


def test_a_stand_in_needs_no_files(cache, derivations):
    brick = load_object("foam_brick", cache_dir=cache)
    assert brick.source == "parametric"
    np.testing.assert_allclose(brick.mesh.extents, (0.075, 0.05, 0.05), atol=1e-9)
    assert len(brick.pieces) == 1 and brick.outward_error_95 < 1e-4
    assert len(brick.resting) == 6
    assert_same(brick, load_object("foam_brick", cache_dir=cache))
    assert len(derivations) == 1
