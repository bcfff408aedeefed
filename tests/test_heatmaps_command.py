"""`python -m mjx_grasp.heatmaps` as a user types it, on small meshes without robot or catalogue."""

import csv
import json
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image
from typed import refusal, typed

from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.files import load_heatmap
from mjx_grasp.heatmap.steering import steer_near, steer_to
from mjx_grasp.objects.catalogue import load_catalogue

COARSE = ("--edge", "0.04")


def heatmaps(*arguments):
    return typed("heatmaps", *arguments)


def slab():
    return trimesh.creation.box(extents=(0.1, 0.04, 0.12)).subdivide_to_size(0.04)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Every kind of mesh file, one that is broken and one in millimetres."""
    path = tmp_path_factory.mktemp("meshes")
    slab().export(path / "slab.obj")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    for kind in ("ply", "stl", "glb", "off"):
        ball.export(path / f"ball_{kind}.{kind}")
    (path / "broken.obj").write_text("v 0 0 zero\nf 1 1 1\n")
    large = slab()
    large.apply_scale(1000.0)
    large.export(path / "millimetres.stl")
    (path / "readme.txt").write_text("no mesh")
    return path


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "new"
    return heatmaps(folder, "--out", out, "--triples", "3", *COARSE), out


GOOD = ["ball_glb", "ball_off", "ball_ply", "ball_stl", "slab"]
BAD = ["broken", "millimetres"]


def test_one_bad_mesh_does_not_stop_the_others_and_is_reported(done):
    run, out = done
    assert run.returncode == 1, run.stderr
    assert "Traceback" not in run.stderr
    assert "broken.obj" in run.stderr and "looks like millimetres" in run.stderr
    assert "written: 5 of 7 heatmaps" in run.stdout
    files = {p.name for p in out.iterdir()}
    expected = {f"{n}.{kind}" for n in GOOD for kind in ("npz", "ply", "triples.json")}
    assert files == expected | {"contact_sheet.png", "summary.csv", "summary.json"}


def test_the_summary_says_what_the_files_hold(done):
    run, out = done
    with (out / "summary.csv").open(newline="") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    summary = json.loads((out / "summary.json").read_text())
    assert sorted(rows) == sorted(r["name"] for r in summary["meshes"]) == sorted(GOOD + BAD)
    for name in GOOD:
        score = load_heatmap(out / f"{name}.npz").heatmap.score
        assert int(rows[name]["vertices"]) == len(score)
        assert float(rows[name]["best_score"]) == pytest.approx(score.max(), abs=1e-6)
        assert float(rows[name]["share_above_0_3"]) == pytest.approx(np.mean(score > 0.3))
        assert name in run.stdout and rows[name]["error"] == ""
    for name in BAD:
        assert rows[name]["best_score"] == "" and rows[name]["error"]
    assert summary["provenance"]["command"].startswith("python -m mjx_grasp.heatmaps")
    assert summary["settings"]["span"] == [0.02, 0.09]


def test_the_heatmap_is_that_of_the_mesh_in_its_own_frame(done):
    stored = load_heatmap(done[1] / "slab.npz")
    assert stored.info.name == "slab" and stored.info.anchor is None
    assert np.allclose(stored.info.com, 0.0, atol=1e-6)
    direct = compute_heatmap(
        np.float64(stored.heatmap.vertices), stored.faces, None, (0.02, 0.09), 0.5
    )
    assert np.allclose(direct.score, stored.heatmap.score, atol=1e-5)
    coloured = trimesh.load(done[1] / "slab.ply", process=False)
    assert len(coloured.vertices) == len(stored.heatmap.score)
    best, worst = np.argmax(stored.heatmap.score), np.argmin(stored.heatmap.score)
    colours = coloured.visual.vertex_colors[:, :3].astype(int)
    assert colours[best].sum() > colours[worst].sum()


def test_triples_are_plain_numbers_best_first_and_apart(done):
    stored = load_heatmap(done[1] / "slab.npz")
    content = json.loads((done[1] / "slab.triples.json").read_text())
    triples = content["triples"]
    assert content["unit"] == "m" and len(triples) == 3
    scores = [t["score"] for t in triples]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] == pytest.approx(float(stored.heatmap.score.max()))
    assert np.shape(triples[0]["wrap"]) == (2, 3)
    thumbs = np.array([t["thumb"] for t in triples])
    wraps = np.array([np.mean(t["wrap"], axis=0) for t in triples])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        gap = max(np.linalg.norm(x[i] - x[j]) for x in (thumbs, wraps))
        assert gap >= 0.02 - 1e-6


def test_the_contact_sheet_shows_every_mesh(done):
    sheet = np.asarray(Image.open(done[1] / "contact_sheet.png").convert("RGB")).astype(int)
    assert min(sheet.shape[:2]) > 300
    # Thumb marks: one red blob per mesh, and one in the legend.
    from scipy.ndimage import binary_closing, label

    red = np.abs(sheet - [235, 60, 40]).max(axis=2) < 40
    assert label(binary_closing(red, iterations=2))[1] == len(GOOD) + 1


def test_an_anchor_steers_and_flags_override_the_hand(folder, tmp_path):
    run = heatmaps(
        folder / "slab.obj", "--out", tmp_path, "--anchor", "0.03", "0.0", "-0.04", "--sigma",
        "0.01", "--span", "0.03", "0.05", "--friction", "0.7", "--steering",
        "between", "--edge", "0.02",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    stored = load_heatmap(tmp_path / "slab.npz")
    assert stored.info.anchor == (0.03, 0.0, -0.04) and stored.info.sigma == 0.01
    assert (stored.info.steering, stored.info.size) == ("between", None)
    assert (stored.info.span, stored.info.friction) == ((0.03, 0.05), 0.7)
    expected = steer_near(stored.heatmap, np.float32([0.03, 0.0, -0.04]), 0.01)
    assert np.allclose(stored.heatmap.score, expected, atol=1e-6)
    best = stored.heatmap.vertices[np.argmax(stored.heatmap.score)]
    assert np.linalg.norm(best[[0, 2]] - [0.03, -0.04]) < 0.021


def test_a_box_of_eight_vertices_is_refined_until_it_can_be_grasped(tmp_path):
    trimesh.creation.box(extents=(0.03, 0.04, 0.05)).export(tmp_path / "box.stl")
    run = heatmaps(tmp_path / "box.stl", "--out", tmp_path / "out")
    assert run.returncode == 0, run.stderr
    heatmap = load_heatmap(tmp_path / "out" / "box.npz").heatmap
    assert len(heatmap.score) > 100 and heatmap.score.max() > 0.8


def test_files_of_the_users_own_are_not_overwritten(tmp_path):
    slab().export(tmp_path / "slab.obj")
    for name in ("slab.ply", "summary.csv"):
        (tmp_path / name).write_text("of somebody else")
        run = heatmaps(tmp_path / "slab.obj", "--out", tmp_path, *COARSE)
        assert run.returncode == 2 and f"{name}, which would be overwritten" in run.stderr
        assert (tmp_path / name).read_text() == "of somebody else"
        (tmp_path / name).unlink()
    for _ in range(2):  # its own are replaced
        run = heatmaps(tmp_path / "slab.obj", "--out", tmp_path, *COARSE)
        assert run.returncode == 0, run.stderr


def test_a_mesh_is_not_overwritten_by_its_coloured_copy(tmp_path):
    mesh = tmp_path / "slab.ply"
    slab().export(mesh)
    before = mesh.read_bytes()
    for asked in (mesh, tmp_path):
        run = heatmaps(asked, "--out", tmp_path, *COARSE)
        assert run.returncode == 2 and "slab.ply, which would be overwritten" in run.stderr
    assert mesh.read_bytes() == before and [*tmp_path.iterdir()] == [mesh]


def test_what_cannot_be_grasped_is_said(tmp_path):
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export(tmp_path / "crate.obj")
    run = heatmaps(tmp_path / "crate.obj", "--out", tmp_path / "out", *COARSE)
    assert run.returncode == 0 and "crate: thumb and fingers can oppose nowhere" in run.stdout


@pytest.mark.parametrize("place", [(), ("--anchor", "0", "0", "0.008")])
def test_of_what_scores_next_to_nothing_it_is_said_too_and_no_triple_is_drawn(tmp_path, place):
    trimesh.creation.icosphere(subdivisions=3, radius=0.008).export(tmp_path / "pea.stl")
    run = heatmaps(tmp_path / "pea.stl", *place, "--out", tmp_path)
    assert run.returncode == 0, run.stderr
    assert load_heatmap(tmp_path / "pea.npz").heatmap.score.max() > 0
    said = " ".join(run.stdout.split())
    assert "pea: thumb and fingers can oppose nowhere on it: the hand spans 20 to 90 mm" in said
    assert "the nearest width is 14.8 mm; see --span" in said
    assert json.loads((tmp_path / "pea.triples.json").read_text())["triples"] == []
    sheet = np.asarray(Image.open(tmp_path / "contact_sheet.png").convert("RGB")).astype(int)
    assert not (np.abs(sheet - [235, 60, 40]).max(axis=2) < 40).any()


def test_instructions_know_the_sides_of_any_mesh_and_the_parts_of_a_scan(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    mug = slab()  # its shape does not matter here
    mug.apply_translation([0.5, 0.0, 0.0])
    mug.export(meshes / "025_mug.ply")
    slab().export(meshes / "slab.obj")
    run = heatmaps(meshes, "--out", tmp_path / "out", "--instruction", "by the handle", *COARSE)
    assert run.returncode == 1
    assert "failed: slab: instruction: found 'by the handle'" in run.stderr
    assert "top, bottom" in run.stderr
    anchor = load_heatmap(tmp_path / "out" / "025_mug.npz").info.anchor
    handle = load_catalogue()["mug"].parts["handle"]
    info = load_heatmap(tmp_path / "out" / "025_mug.npz").info
    assert np.allclose(anchor, np.add(handle.at, [0.5, 0, 0]), atol=1e-3)
    assert (info.steering, info.size, info.sigma) == ("contacts", handle.size, None)
    run = heatmaps(
        meshes / "slab.obj", "--out", tmp_path / "top", "--instruction", "the top", *COARSE
    )
    assert run.returncode == 0, run.stderr
    assert np.allclose(load_heatmap(tmp_path / "top" / "slab.npz").info.anchor, [0, 0, 0.06])


@pytest.mark.parametrize("steering", ["contacts", pytest.param("axis", marks=pytest.mark.long)])
def test_a_part_of_a_mesh_steers_by_its_size_or_as_published(tmp_path, steering):
    slab().export(tmp_path / "slab.obj")
    part = "parts: {grip: {at: [0.03, 0.0, 0.04], size: [0.03, 0.05, 0.05]}}"
    (tmp_path / "slab.yaml").write_text(part)
    out = tmp_path / "out"
    run = heatmaps(
        tmp_path / "slab.obj", "--out", out, "--instruction", "the grip", "--edge", "0.01",
        "--steering", steering,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    stored = load_heatmap(out / "slab.npz")
    place = np.float32([0.03, 0.0, 0.04]), np.float32([0.03, 0.05, 0.05])
    expected = steer_to(stored.heatmap, *place, steering=steering)
    assert np.allclose(stored.heatmap.score, expected, atol=1e-6)
    best = json.loads((out / "slab.triples.json").read_text())["triples"][0]
    contacts = np.array([best["thumb"], *best["wrap"]])
    on_part = np.abs(contacts - place[0]).max(axis=0) <= place[1] / 2 + 1e-4
    assert on_part.all() or steering == "axis"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{folder}/none.obj"], "no such file or folder"),
        (["{folder}/readme.txt"], "extension '.txt'"),
        (["{empty}"], "no meshes"),
        (["{folder}/broken.obj"], "broken.obj"),
        (["{folder}/millimetres.stl"], "looks like millimetres"),
        (["{folder}", "--anchor", "0", "0", "0", "--instruction", "top"], "one of them at most"),
        (["{folder}/slab.obj", "--anchor", "10", "20", "30"], "near slab.obj"),
        (["{folder}/slab.obj", "--instruction", "by the trunk"], "one of top, bottom"),
        (["{folder}", "--span", "0.09", "0.02"], "--span"),
        (["{folder}", "--friction", "0"], "--friction"),
        (["{folder}", "--sigma", "-1"], "--sigma"),
        (["{folder}", "--steering", "axis"], "an --anchor or an --instruction"),
        (["{folder}", "--sigma", "0.01"], "an --anchor or an --instruction"),
        (["{folder}", "--out", "{folder}/slab.obj/maps"], "can be written (Not a directory)"),
        (["{folder}", "--triples", "0"], "--triples"),
        (["{folder}", "--temperature", "-1"], "--temperature"),
        (["{folder}", "--edge", "-1"], "--edge: found -1.0"),
        (["{folder}", "--out", "{folder}/readme.txt"], "a folder"),
    ],
)
def test_mistakes_are_refused_before_anything_is_written(
    folder, tmp_path, arguments, text, monkeypatch, capsys
):
    empty = tmp_path / "empty"
    empty.mkdir()
    filled = [a.format(folder=folder, empty=empty) for a in arguments]
    if "--out" not in filled:
        filled += ["--out", tmp_path / "out"]
    status, error = refusal(monkeypatch, capsys, "heatmaps", *filled)
    assert status == 2
    shown = " ".join(error.replace("│", " ").split())
    assert text in shown and "error" in shown.lower()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("flag", "count"), [("--anchor", 3), ("--span", 2)])
def test_too_few_numbers_are_refused_by_how_many_there_should_be(
    folder, flag, count, monkeypatch, capsys
):
    status, error = refusal(monkeypatch, capsys, "heatmaps", folder / "slab.obj", flag, "0.1")
    assert status == 2 and f"'{flag}'. Expected {count} values" in error and "typing" not in error


def test_a_refusal_is_one_line_in_the_shell(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "mjx_grasp.heatmaps", "none.obj"],
        capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert run.returncode == 2
    assert run.stderr.startswith("error: ") and run.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_official_download_is_found_and_equal_stems_are_told_apart(tmp_path):
    from mjx_grasp.errors import FileError
    from mjx_grasp.objects.catalogue import catalogue_entry
    from mjx_grasp.objects.folder import find_meshes

    scan = tmp_path / "025_mug" / "google_16k"
    scan.mkdir(parents=True)
    for name in ("nontextured.ply", "textured.obj"):
        (scan / name).touch()
    for name in ("a.obj", "a.stl", "b.OFF", "c.txt", "025_mug.obj"):
        (tmp_path / name).touch()
    found = {f.name: f.path for f in find_meshes(tmp_path)}
    assert list(found) == ["025_mug", "025_mug.obj", "a.obj", "a.stl", "b"]
    assert found["025_mug"].name == "nontextured.ply"
    assert catalogue_entry("025_mug").name == "mug"
    assert catalogue_entry("019_pitcher_base").name == "pitcher_base"
    assert catalogue_entry("mug") is None, "a user's own mug has other parts"
    with pytest.raises(FileError, match="no such file or folder"):
        find_meshes(tmp_path / "none")
