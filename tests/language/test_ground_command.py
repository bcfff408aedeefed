"""`python -m mjx_grasp.ground` on files as a camera gives them, with a model that is made up."""

import json
import runpy
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from test_rex_omni import FakeModel, FakeProcessor, answer
from typed import refusal

from mjx_grasp.language import rex_omni
from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.language.rex_omni import RexOmniGrounder
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.parametric import stand_in

WIDTH, HEIGHT, FOCAL = 96, 72, 150.0
SHIFT = np.array([0.2, -0.1, 0.05])  # of the mesh's own frame from the middle of its box
TURN = Rotation.from_euler("xyz", [0.3, -0.2, 1.1])
AT = np.array([0.5, 0.1, 0.2])


def looking_at_it():
    """A camera 0.4 m from the mug's handle, with its middle in the middle of the picture."""
    handle = TURN.apply(load_catalogue()["mug"].parts["handle"].at + SHIFT) + AT
    out = TURN.apply([0.7, -0.6, 0.4])
    forward = -out / np.linalg.norm(out)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R_wc = np.stack([right, np.cross(forward, right), forward], axis=1)
    middle = (WIDTH / 2, HEIGHT / 2)
    return PinholeCamera(WIDTH, HEIGHT, FOCAL, FOCAL, *middle, R_wc, handle - 0.4 * forward)


def depth_of(mesh, camera):
    """Cast by trimesh: depth along the optical axis [m], 0 beside the mug."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = [camera.ray(pixel) for pixel in np.stack([columns, rows], axis=-1).reshape(-1, 2)]
    world = mesh.copy()
    world.vertices = TURN.apply(world.vertices) + AT
    origins, directions = (np.array(x) for x in zip(*rays, strict=True))
    hit, ray, _ = world.ray.intersects_location(origins, directions, multiple_hits=False)
    depth = np.zeros(WIDTH * HEIGHT)
    depth[ray] = (hit - camera.p_wc) @ camera.R_wc[:, 2]
    return depth.reshape(HEIGHT, WIDTH)


def said(rotation, position):
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return {"position": list(position), "quaternion": [w, x, y, z]}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seen")
    mug = stand_in("mug")
    mug.apply_translation(SHIFT)
    mug.export(folder / "mug.ply")
    camera = looking_at_it()
    depth = depth_of(mug, camera)
    np.save(folder / "depth.npy", depth.astype(np.float32))
    Image.fromarray(np.round(1e3 * depth).astype(np.uint16)).save(folder / "depth.png")
    grey = np.where(depth > 0, 200, 30).astype(np.uint8)
    Image.fromarray(np.dstack([grey] * 3)).save(folder / "image.png")
    content = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    content |= {"camera": said(camera.R_wc, camera.p_wc), "object": said(TURN.as_matrix(), AT)}
    (folder / "camera.json").write_text(json.dumps(content))
    (folder / "weights").mkdir()
    (folder / "weights" / "config.json").write_text("{}")
    return folder, camera, depth


@pytest.fixture
def extra(monkeypatch):
    """As if torch and transformers were installed; loading must be replaced."""
    monkeypatch.setattr(rex_omni, "find_spec", lambda name: name)


def arguments(folder, **other):
    given = {
        "instruction": "by the handle", "image": folder / "image.png",
        "depth": folder / "depth.npy", "camera": folder / "camera.json",
        "weights": folder / "weights",
    } | other  # fmt: skip
    flags = [str(word) for name, value in given.items() for word in (f"--{name}", value)]
    return [str(folder / "mug.ply"), *flags]


def answering(monkeypatch, text):
    """The weights are replaced by one that knows this answer; gives what it was loaded with."""
    loaded = []

    def load(config):
        loaded.append(config)
        return RexOmniGrounder(FakeModel(), FakeProcessor(text), config)

    monkeypatch.setattr(RexOmniGrounder, "load", load)
    return loaded


def run(monkeypatch, capsys, given):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "argv", ["ground", *given])
    runpy.run_module("mjx_grasp.ground", run_name="__main__", alter_sys=True)
    return capsys.readouterr().out


def bins(pixel):
    return "".join(f"<{round(999 * x / n)}>" for x, n in zip(pixel, (WIDTH, HEIGHT), strict=True))


@pytest.mark.parametrize("depth", ["depth.npy", "depth.png"])
def test_a_picture_and_an_instruction_become_an_anchor(files, extra, monkeypatch, capsys, depth):
    folder, camera, measured = files
    rows, columns = np.nonzero(measured)
    k = np.argmin(np.hypot(rows - HEIGHT / 2, columns - WIDTH / 2))
    pixel = np.array([columns[k] + 0.5, rows[k] + 0.5])
    loaded = answering(monkeypatch, answer(bins(pixel)))
    out = folder / "anchor.json"
    given = arguments(folder, depth=folder / depth, out=out)
    first, second, source = run(monkeypatch, capsys, given).splitlines()
    assert loaded[0].model == str(folder / "weights")
    seen = camera.back_project(pixel, measured[rows[k], columns[k]])
    expected = TURN.inv().apply(seen - AT)
    anchor = [float(word) for word in first.split()[1:4]]
    assert np.allclose(anchor, expected, atol=1.5e-3)
    assert np.allclose([float(w) for w in second.split()[1:4]], expected - SHIFT, atol=1.5e-3)
    handle = load_catalogue()["mug"].parts["handle"]
    assert np.linalg.norm(expected - SHIFT - handle.at) < 0.03, "the made-up answer is the handle"
    assert first.endswith("# frame of the mesh") and "pixel" in source and "depth" in source
    written = json.loads(out.read_text())
    assert np.allclose(written["anchor_m"], anchor, atol=1e-4)
    assert written["instruction"] == "by the handle" and written["mesh"] == "mug.ply"


def test_an_answer_beside_the_object_is_refused(files, extra, monkeypatch, capsys):
    folder, *_ = files
    answering(monkeypatch, answer(bins((1.0, 1.0))))
    status, error = refusal(monkeypatch, capsys, "ground", *arguments(folder, limit=0.001))
    assert status == 2 and "by the handle" in error and "passes mug" in error


def damaged(folder, tmp_path):
    """Files that cannot be used, by flag, and what is said of them."""
    camera = json.loads((folder / "camera.json").read_text())

    def write(name, content):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    np.save(tmp_path / "small.npy", np.ones((HEIGHT // 2, WIDTH)))
    np.save(tmp_path / "flat.npy", np.ones(HEIGHT * WIDTH))
    np.save(tmp_path / "millimetres.npy", np.full((HEIGHT, WIDTH), 400, np.uint16))
    np.save(tmp_path / "words.npy", np.full((HEIGHT, WIDTH), "a"))
    Image.fromarray(np.ones((HEIGHT, WIDTH), np.uint8)).save(tmp_path / "eight.png")
    no_focus = {k: v for k, v in camera.items() if k != "fx"}
    long = camera | {"object": camera["object"] | {"quaternion": [1, 1, 0, 0]}}
    (tmp_path / "empty").mkdir()
    return [
        ("image", tmp_path / "none.png", "no such file"),
        ("image", write("text.png", "no picture"), "a picture"),
        ("depth", tmp_path / "none.npy", "none.npy"),
        ("depth", tmp_path / "millimetres.npy", "whole numbers (uint16)"),
        ("depth", tmp_path / "small.npy", f"{WIDTH}×{HEIGHT}"),
        ("depth", tmp_path / "flat.npy", "of shape"),
        ("depth", tmp_path / "words.npy", "of shape"),
        ("depth", tmp_path / "eight.png", "8 bits of depth"),
        ("depth", write("text.npy", "no depth"), "nothing readable"),
        ("camera", tmp_path / "none.json", "no such file"),
        ("camera", write("text.json", "fx: 3"), "no JSON"),
        ("camera", write("half.json", no_focus), "CameraFile.fx"),
        ("camera", write("long.json", long), "unit length"),
        ("camera", write("more.json", camera | {"k1": 0.1}), "k1"),
        ("camera", write("zero.json", camera | {"fx": 0}), "CameraFile.fx"),
        ("weights", tmp_path / "none", "no such folder"),
        ("weights", tmp_path / "empty", "no config.json"),
        ("out", tmp_path / "missing" / "a.json", "does not exist"),
        ("instruction", "please", "no place in it"),
        ("limit", "-1", "--limit"),
    ]


def test_what_cannot_be_used_is_refused_before_weights_are_loaded(
    files, extra, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(RexOmniGrounder, "load", lambda *_: pytest.fail("it went on"))
    folder, *_ = files
    for flag, value, text in damaged(folder, tmp_path):
        given = arguments(folder, **{flag: value})
        status, error = refusal(monkeypatch, capsys, "ground", *given)
        shown = " ".join(error.replace("│", " ").split())
        assert status == 2 and text in shown, (flag, str(value), shown)


def test_without_the_extra_the_command_says_how_to_get_it(files, monkeypatch, capsys):
    monkeypatch.setattr(rex_omni, "find_spec", {"torch": "there"}.get)
    monkeypatch.setattr(RexOmniGrounder, "load", lambda *_: pytest.fail("it went on"))
    status, error = refusal(monkeypatch, capsys, "ground", *arguments(files[0]))
    assert status == 2 and "no transformers" in error and "mjx_grasp[language]" in error


def test_the_mesh_itself_is_checked(files, tmp_path, monkeypatch, capsys):
    folder, *_ = files
    trimesh.creation.box(extents=(50.0, 40.0, 30.0)).export(tmp_path / "large.stl")
    given = [str(tmp_path / "large.stl"), *arguments(folder)[1:]]
    status, error = refusal(monkeypatch, capsys, "ground", *given)
    assert status == 2 and "millimetres" in error
