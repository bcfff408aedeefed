"""A mesh of a user's in the commands: start states, their evaluation, parts, and refusals."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
from typed import refusal, typed

from mjx_grasp.evaluation.results import read_results
from mjx_grasp.handoff.dataset import load_handoffs

EXAMPLE = Path(__file__).parent / "data" / "jug.yaml"
FEW = (
    *("--per-object", "4", "--max-rounds", "2", "--sampling.poses-per-round", "24"),
    *("--posture.library", "4000"),
)


def command(module, *arguments):
    return subprocess.run(
        [sys.executable, "-m", f"mjx_grasp.{module}", *map(str, arguments)],
        capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a tin, and start states made for it."""
    folder = tmp_path_factory.mktemp("own")
    tin = trimesh.creation.cylinder(radius=0.03, height=0.11).apply_translation((0.4, 0.0, 0.1))
    tin.export(folder / "mug.stl")  # called like an object of the catalogue
    done = command("handoffs", "--objects", folder / "mug.stl", "--out", folder / "s.npz", *FEW)
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.mark.long
def test_start_states_of_a_mesh_are_made_and_its_weight_is_said(made):
    folder, done = made
    assert "mug.stl: 0.15" in done.stderr and "assuming 500 kg/m³" in done.stderr
    stored = load_handoffs(folder / "s.npz")
    assert stored.object_names == ("mug.stl",) and len(stored) == 4


@pytest.mark.long
def test_they_load_again_with_the_mesh(made, tmp_path):
    folder, _ = made
    out = tmp_path / "e.json"
    done = command(
        *("evaluate", "--controller", "squeeze", "--objects", folder / "mug.stl"),
        *("--handoffs", folder / "s.npz", "--states", "all", "--episodes", "2", "--worlds", "2"),
        *("--mass", "0.2", "--out", out),
    )
    assert done.returncode == 0, done.stderr
    assert "mug.stl: 0.2 kg, as asked for" in done.stderr
    assert "stand-ins" not in done.stdout
    assert [row.object for row in read_results(out).rows] == ["mug.stl"]
    assert json.loads(out.read_text())["settings"]["mass"] == 0.2


@pytest.mark.long
def test_they_are_refused_with_another_mesh_of_that_name(made, tmp_path, monkeypatch, capsys):
    folder, _ = made
    trimesh.creation.box(extents=(0.05, 0.06, 0.09)).export(tmp_path / "mug.stl")
    status, error = refusal(
        *(monkeypatch, capsys, "evaluate", "--controller", "squeeze"),
        *("--objects", tmp_path / "mug.stl", "--handoffs", folder / "s.npz"),
        *("--states", "all", "--out", tmp_path / "e.json"),
    )
    assert status == 2 and "states for another mesh" in error


@pytest.fixture
def meshes(tmp_path, monkeypatch):
    """A folder to be in, with meshes that cannot be objects."""
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box(extents=(50, 60, 90)).export("mm.obj")
    Path("empty.obj").write_text("v 0 0 0\n")
    jug = trimesh.creation.box(extents=(0.1, 0.06, 0.12)).apply_translation((0.0, 0.0, 0.06))
    jug.export("jug.obj")
    shutil.copy(EXAMPLE, "jug.yaml")
    return tmp_path


TRAIN = ("train", "--preset", "cpu")
HANDOFFS = ("handoffs", "--out", "x.npz")


@pytest.mark.parametrize("command", [HANDOFFS, TRAIN], ids=lambda command: command[0])
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--objects", "none.obj"), "none.obj: found no such file or folder"),
        (("--objects", "empty.obj"), "empty.obj"),
        (("--objects", "mm.obj"), "looks like millimetres"),
        (("--objects", "jug.obj", "--mass", "0"), "--mass"),
        (("--objects", "jug.obj", "--mass", "1", "--density", "9"), "--mass and --density"),
        (("--objects", "foam_brick", "--density", "9"), "found 'foam_brick', expected a mesh"),
    ],
)
def test_what_cannot_be_an_object_is_refused(meshes, monkeypatch, capsys, command, arguments, text):
    before = sorted(meshes.rglob("*"))
    status, error = refusal(monkeypatch, capsys, *command, *arguments)
    shown = " ".join(error.translate(str.maketrans("│╭╮╰╯─", "      ")).split())
    assert status == 2 and text in shown and "Traceback" not in shown
    assert sorted(meshes.rglob("*")) == before


def test_instructions_know_the_parts_beside_a_mesh(meshes, monkeypatch, capsys):
    done = typed("heatmaps", "jug.obj", "--out", "o", "--edge", "0.04", "--instruction", "spout")
    assert done.returncode == 0, done.stderr
    shown = json.loads((meshes / "o" / "jug.triples.json").read_text())
    assert shown["anchor"] == pytest.approx([-0.045, 0.0, 0.11])
    status, error = refusal(
        *(monkeypatch, capsys, "heatmaps", "jug.obj", "--out", "p", "--instruction", "by the lid")
    )
    assert status == 2 and "handle, spout" in error


def test_parts_in_millimetres_are_refused(meshes, monkeypatch, capsys):
    Path("jug.yaml").write_text("parts: {handle: [55, 0, 70]}\n")
    status, error = refusal(monkeypatch, capsys, *HANDOFFS, "--objects", "jug.obj")
    assert status == 2 and "jug.yaml: found handle at [55.0, 0.0, 70.0]" in error
