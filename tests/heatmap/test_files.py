import json

import jax
import numpy as np
import pytest
import trimesh
from forging import rewrite
from made_up import made_up

from mjx_grasp.errors import FileError
from mjx_grasp.heatmap.colours import VOID, score_colours
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.files import TERMS, HeatmapInfo, load_heatmap, save_heatmap, write_ply
from mjx_grasp.heatmap.steering import steer

INFO = HeatmapInfo("thing", (0.02, 0.09), 0.5, (0.0, 0.001, 0.0), (0.01, 0.0, 0.02), 0.03)
DOCUMENTED = {
    *("vertices", "normals", "score", "score_without_com", "thumb", "wrap", "axis"),
    *("width", "valid", *(f"term_{name}" for name in TERMS)),
}
FACES = np.array([[0, 1, 2], [2, 1, 3]])


@pytest.fixture
def stored(tmp_path):
    heatmap = made_up([0.1, 0.9, 0.0, 0.4], valid=[True, True, False, True])
    path = tmp_path / "thing.npz"
    save_heatmap(path, heatmap, FACES, INFO)
    return path, heatmap


def test_everything_comes_back(stored):
    path, heatmap = stored
    read = load_heatmap(path)
    assert read.info == INFO
    assert np.array_equal(read.faces, FACES)
    jax.tree.map(np.testing.assert_array_equal, read.heatmap, heatmap)


def test_the_documented_members_are_there_for_anybody_with_numpy(stored):
    path, heatmap = stored
    with np.load(path) as file:
        names = set(file.files)
        assert names >= DOCUMENTED
        assert file["wrap"].shape == (4, 2, 3)
        assert np.array_equal(file["term_com"], heatmap.terms["com"])
        header = json.loads(str(file["header"]))
        assert {k: header[k] for k in ("version", "anchor")} == {
            "version": 2,
            "anchor": [0.01, 0.0, 0.02],
        }


def test_a_real_heatmap_is_steered_after_reading_as_before(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    heatmap = compute_heatmap(mesh.vertices, mesh.faces, None, (0.02, 0.09), 0.5)
    save_heatmap(tmp_path / "ball.npz", heatmap, mesh.faces, INFO)
    read = load_heatmap(tmp_path / "ball.npz").heatmap
    anchor = np.float32([0.01, 0.0, 0.0])
    assert np.array_equal(steer(read, anchor), steer(heatmap, anchor))


def header_with(**fields):
    return lambda arrays, header: header.update(fields)


def replacing(name, value):
    return lambda arrays, header: arrays.update({name: value(arrays[name])})


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (header_with(format="other"), "another kind"),
        (header_with(version=3), "version 3"),
        (header_with(friction=0.7), "checksum"),
        (lambda arrays, header: arrays.pop("wrap"), "checksum"),
        (replacing("score", lambda s: s[::-1].copy()), "checksum"),
        (replacing("width", lambda w: w[:-1]), "checksum"),
    ],
)
def test_a_changed_file_is_refused(stored, change, found):
    path, _ = stored
    rewrite(path, change)
    with pytest.raises(FileError, match=found) as error:
        load_heatmap(path)
    assert error.value.path == path


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (header_with(span=[0.02, -1.0]), "span"),
        (header_with(com="here"), "com"),
        (replacing("score", lambda s: s + 1), "score outside"),
        (replacing("term_com", lambda t: -t), "term_com outside"),
        (replacing("faces", lambda f: f + 9), "vertices below 4"),
        (replacing("wrap", lambda w: w[:3]), "wrap float32"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_right_checksum(stored, change, found):
    rewrite(stored[0], change, sign=True)
    with pytest.raises(FileError, match=found):
        load_heatmap(stored[0])


def test_missing_foreign_and_cut_files_are_refused(stored, tmp_path):
    path, _ = stored
    whole = path.read_bytes()
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.save(tmp_path / "array.npy", np.zeros(3))
    for length in (0, 40, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:length])
        with pytest.raises(FileError, match=r"thing\.npz"):
            load_heatmap(path)
    for name in ("none.npz", "text.npz", "other.npz", "array.npy"):
        with pytest.raises(FileError, match=name):
            load_heatmap(tmp_path / name)


def test_what_cannot_be_a_heatmap_is_not_written(tmp_path):
    heatmap = made_up([0.1, 0.9, 0.0, 0.4])
    path = tmp_path / "bad.npz"
    for bad, found in (
        (heatmap._replace(score=np.float32([0.1, np.nan, 0, 0])), "not finite"),
        (heatmap._replace(score=np.float32([0.1, 7.0, 0, 0])), "outside"),
        (heatmap._replace(wrap=heatmap.wrap[:3]), "wrap"),
    ):
        with pytest.raises(FileError, match=found):
            save_heatmap(path, bad, FACES, INFO)
    with pytest.raises(FileError, match="vertices below 4"):
        save_heatmap(path, heatmap, FACES + 1, INFO)
    assert not list(tmp_path.iterdir())


def test_trimesh_reads_the_coloured_mesh(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    score = np.linspace(0, 1, len(mesh.vertices))
    heatmap = made_up(score, mesh.vertices, valid=np.arange(len(score)) != 7)
    write_ply(tmp_path / "ball.ply", heatmap, mesh.faces)
    read = trimesh.load(tmp_path / "ball.ply", process=False)
    assert np.allclose(read.vertices, mesh.vertices, atol=1e-7)
    assert np.array_equal(read.faces, mesh.faces)
    colours = read.visual.vertex_colors[:, :3].astype(int)
    assert tuple(colours[0]) == (68, 1, 84), "purple"
    assert tuple(colours[-1]) == (253, 231, 37), "yellow"
    assert tuple(colours[7]) == VOID
    quality = read.metadata["_ply_raw"]["vertex"]["data"]["quality"].ravel()
    assert np.allclose(quality, score, atol=1e-6)


def test_steered_scores_colour_the_mesh_instead(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    heatmap = made_up(np.zeros(len(mesh.vertices)), mesh.vertices)
    steered = heatmap._replace(score=np.full(len(mesh.vertices), 0.5))
    write_ply(tmp_path / "a.ply", steered, mesh.faces)
    read = trimesh.load(tmp_path / "a.ply", process=False)
    half = score_colours(np.array([0.5]))[0]
    assert np.all(read.visual.vertex_colors[:, :3] == half)


def test_colours_rise_from_purple_to_yellow_and_stop_at_the_top():
    colours = score_colours(np.array([0.0, 0.4, 0.8, 0.9, np.nan]), top=0.8).astype(int)
    luminance = colours @ [0.2126, 0.7152, 0.0722]
    assert luminance[0] < luminance[1] < luminance[2]
    assert np.array_equal(colours[2], colours[3])
    assert tuple(colours[4]) == VOID
