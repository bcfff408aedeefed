"""Meshes of a user's as objects: names, weights, parts, and what is refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.objects.catalogue import find_objects, load_catalogue, resolve
from mjx_grasp.objects.config import DENSITY, ObjectsConfig, Weight
from mjx_grasp.objects.folder import MeshFile
from mjx_grasp.objects.model import load_object, load_objects
from mjx_grasp.objects.parts import parts_of

EXAMPLE = Path(__file__).parent.parent / "data" / "jug.yaml"
EXTENTS = (0.1, 0.06, 0.12)
MIDDLE = (0.0, 0.0, 0.06)


@pytest.fixture
def jug(tmp_path):
    """A box standing on z = 0, with the example's parts beside it."""
    path = tmp_path / "jug.obj"
    trimesh.creation.box(extents=EXTENTS).apply_translation(MIDDLE).export(path)
    shutil.copy(EXAMPLE, tmp_path)
    return path


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


def test_a_mesh_is_an_object_in_the_object_frame(jug, cache):
    loaded = load_object(str(jug), cache_dir=cache, weight=Weight(mass=0.3))
    assert (loaded.name, loaded.source, loaded.mass) == ("jug.obj", "mesh", 0.3)
    np.testing.assert_allclose(loaded.mesh.bounds, np.outer((-0.5, 0.5), EXTENTS), atol=1e-9)
    square = np.square(EXTENTS)
    np.testing.assert_allclose(np.diag(loaded.inertia), 0.3 / 12 * (square.sum() - square))
    assert len(loaded.pieces) == 1 and len(loaded.resting) == 6
    assert loaded.parts["handle"].at == pytest.approx((0.055, 0.0, 0.01))


def test_the_content_is_the_shape_whatever_the_file_is_called(jug, cache):
    loaded = load_object(str(jug), cache_dir=cache)
    jug.rename(jug.with_name("crate.obj"))
    again = load_object(str(jug.with_name("crate.obj")), cache_dir=cache)
    assert again.name == "crate.obj" and again.content_hash == loaded.content_hash


def test_what_a_mesh_weighs_is_said(jug, cache, capsys):
    litres = 1e3 * np.prod(EXTENTS)
    for weight, kilograms, why in (
        (None, 1e-3 * DENSITY * litres, f"assuming {DENSITY:g} kg/m³"),
        (Weight(density=250.0), 0.25 * litres, "at 250 kg/m³"),
        (Weight(mass=0.4), 0.4, "as asked for"),
    ):
        (loaded,) = load_objects([str(jug)], cache_dir=cache, weight=weight)
        assert loaded.mass == pytest.approx(kilograms)
        said = " ".join(capsys.readouterr().err.split())
        assert f"jug.obj: {kilograms:.3g} kg" in said and why in said
    (brick,) = load_objects(["foam_brick"], cache_dir=cache)
    assert brick.mass == load_catalogue()["foam_brick"].mass
    assert "kg" not in capsys.readouterr().err


def test_what_is_called_like_a_scan_weighs_what_that_does(jug, cache, capsys):
    scan = jug.with_name("025_mug.obj")
    shutil.copy(jug, scan)
    (loaded,) = load_objects([str(scan)], cache_dir=cache)
    assert loaded.mass == load_catalogue()["mug"].mass
    assert "as the catalogue's mug" in " ".join(capsys.readouterr().err.split())
    assert load_objects([str(scan)], cache_dir=cache, weight=Weight(mass=0.4))[0].mass == 0.4


@pytest.mark.parametrize(
    ("weight", "flag"), [(Weight(mass=300.0), "--mass"), (Weight(density=5e5), "--density")]
)
def test_a_mass_in_grams_is_noticed(jug, cache, weight, flag):
    with pytest.raises(InputError, match=rf"{flag}: found '\d+ kg for jug\.obj', .*units are kg"):
        load_objects([str(jug)], cache_dir=cache, weight=weight)


@pytest.mark.parametrize(
    ("weight", "flag"), [(Weight(mass=3e-4), "--mass"), (Weight(density=0.5), "--density")]
)
def test_a_mass_in_tonnes_is_noticed(jug, cache, weight, flag):
    expected = rf"{flag}: found '[\d.e-]+ kg for jug\.obj', .*kg at least.*units are kg"
    with pytest.raises(InputError, match=expected):
        load_objects([str(jug)], cache_dir=cache, weight=weight)


def test_names_come_from_files_and_are_none_of_the_catalogues(jug, tmp_path, monkeypatch):
    others = tmp_path / "others"
    others.mkdir()
    for name in ("mug.obj", "mug.stl", "bowl.ply"):
        trimesh.creation.box(extents=EXTENTS).export(others / name)
    assert resolve([str(others)]) == ("bowl.ply", "mug.obj", "mug.stl")
    monkeypatch.chdir(tmp_path)
    assert resolve(["mug", "jug.obj", "others", str(jug)]) == (
        *("mug", "jug.obj", "bowl.ply", "mug.obj", "mug.stl"),
    )
    assert not set(resolve(["others"])) & set(load_catalogue())
    monkeypatch.chdir(others)
    assert resolve(["mug"]) == ("mug",), "the catalogue's comes before a file"


def test_two_meshes_of_a_name_are_refused(jug, tmp_path):
    another = tmp_path / "another" / "jug.obj"
    another.parent.mkdir()
    shutil.copy(jug, another)
    with pytest.raises(InputError, match="different names"):
        resolve([str(jug), str(another)])


@pytest.mark.parametrize("path", ["none.obj", "folder/none", "none.STL"])
def test_a_missing_mesh_is_refused(path):
    with pytest.raises(FileError, match="no such file or folder"):
        resolve([path])


def test_a_file_of_another_kind_and_an_empty_folder_are_refused(tmp_path):
    (tmp_path / "cup.step").touch()
    with pytest.raises(FileError, match=r"extension '\.step'"):
        resolve([str(tmp_path / "cup.step")])
    with pytest.raises(FileError, match="no meshes"):
        resolve([str(tmp_path)])


def test_a_weight_needs_a_mesh_and_is_given_once(jug, cache):
    with pytest.raises(InputError, match="--mass or --density"):
        load_objects(["foam_brick"], cache_dir=cache, weight=Weight(mass=1.0))
    with pytest.raises(InputError, match="--mass and --density"):
        ObjectsConfig(objects=(str(jug),), mass=1.0, density=500.0)
    assert ObjectsConfig(objects=(str(jug),)).scans is None
    assert ObjectsConfig().scans is False


def test_one_object_is_not_a_folder(jug, tmp_path, cache):
    shutil.copy(jug, tmp_path / "cup.obj")
    with pytest.raises(InputError, match="one mesh"):
        load_object(str(tmp_path), cache_dir=cache)


def test_parts_are_those_beside_the_mesh_or_of_the_scan(jug):
    mesh = trimesh.load_mesh(jug)
    parts = parts_of(MeshFile("jug", jug), mesh)
    assert {name: part.at for name, part in parts.items()} == {
        "handle": pytest.approx((0.055, 0.0, 0.01)),
        "spout": pytest.approx((-0.045, 0.0, 0.05)),
    }
    assert all(part.size == (0.0, 0.0, 0.0) for part in parts.values())
    boxed = "parts: {handle: {at: [0.055, 0, 0.07], size: [0.02, 0.02, 0.08]}}"
    jug.with_suffix(".yaml").write_text(boxed)
    (handle,) = parts_of(MeshFile("jug", jug), mesh).values()
    assert handle.at == parts["handle"].at and handle.size == (0.02, 0.02, 0.08)
    jug.with_suffix(".yaml").unlink()
    assert parts_of(MeshFile("jug", jug), mesh) == {}
    assert parts_of(MeshFile("025_mug", jug), mesh) == load_catalogue()["mug"].parts


def test_an_object_of_the_catalogue_has_no_other_weight_and_a_mesh_may_be_a_path(jug):
    with pytest.raises(InputError, match="--mass or --density: found 'mug'"):
        load_object("mug", weight=Weight(mass=5.0))
    assert load_object(jug, weight=Weight(mass=0.3)).mass == 0.3
    with pytest.raises(InputError, match="xxx"):
        find_objects("x" * 300)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no parts that can be read"),
        ("parts: [", "no parts that can be read"),
        ("- handle", "no parts that can be read"),
        ("handle: [0, 0, 0]", "fields handle"),
        ("parts: {handle: 3}", "part 'handle'"),
        ("parts: {handle: [0, 0]}", "part 'handle'"),
        ("parts: {handle: [0, 0, x]}", "no parts that can be read"),
        ("parts: {handle: [0, 0, .nan]}", "part 'handle'"),
        ("parts: {handle: {at: [0, 0, 0], size: 0.01}}", "part 'handle'"),
        ("parts: {handle: {at: [0, 0, 0], size: [-1, 1, 1]}}", "part 'handle'"),
        ("parts: {handle: {size: [0.1, 0.1, 0.1]}}", "part 'handle'"),
        ("parts: {Upper handle: [0, 0, 0]}", "part 'Upper handle'"),
        ("parts: {3: [0, 0, 0]}", "no parts that can be read"),
        ("parts: {handle: [55, 0, 70]}", "handle at [55.0, 0.0, 70.0]"),
        ("parts: {handle: {at: [0, 0, 0], size: [20, 20, 20]}}", "of size [20.0, 20.0, 20.0]"),
        ("parts: {handle: '123'}", "part 'handle'"),
        ("parts: {handle: [true, 0, 0]}", "part 'handle'"),
        ("parts: " + 3000 * "[", "no parts that can be read"),
    ],
)
def test_parts_that_cannot_be_are_refused(jug, text, said):
    jug.with_suffix(".yaml").write_text(text)
    with pytest.raises(FileError) as refusal:
        parts_of(MeshFile("jug", jug), trimesh.load_mesh(jug))
    assert refusal.value.path.name == "jug.yaml"
    assert said in refusal.value.found
