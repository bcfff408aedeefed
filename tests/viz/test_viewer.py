"""The viewer in a real, headless browser; and the command that starts it."""

import os
import signal
import subprocess
import sys
import urllib.request
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from browser import (
    browsing,
    control,
    drag,
    free_port,
    need_viser,
    number,
    on_screen,
    shot,
    wait,
)
from typed import refusal

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.files import HeatmapInfo, StoredHeatmap, save_heatmap
from mjx_grasp.language.grounding import target_of
from mjx_grasp.objects.catalogue import Part
from mjx_grasp.viz.viewer_state import ViewerSettings
from mjx_grasp.viz.viewing import check_host

HANDLE = Part((0.0, 0.0, 0.04), (0.06, 0.04, 0.08))


@pytest.fixture(scope="module")
def stored():
    mesh = trimesh.creation.box(extents=(0.06, 0.04, 0.16)).subdivide_to_size(0.03)
    heatmap = compute_heatmap(mesh.vertices, mesh.faces, None, (0.02, 0.09), 0.5)
    info = HeatmapInfo("box", (0.02, 0.09), 0.5, (0.0, 0.0, 0.0))
    return StoredHeatmap(heatmap, np.asarray(mesh.faces), info), target_of(
        "box", mesh, {"handle": HANDLE}
    )


@pytest.fixture(scope="module")
def viewer(stored):
    need_viser()
    from mjx_grasp.viz.viewer import Viewer

    made = Viewer(*stored, ViewerSettings(anchor=(0.0, 0.0, 0.0)), port=free_port())
    yield made
    made.close()


@pytest.fixture(scope="module")
def page(viewer):
    with browsing(viewer.url) as opened:
        wait(lambda: "score" in opened.inner_text("body"), 60)
        wait(lambda: mesh_pixels(shot(opened)).mean() > 0.02, 60)
        yield opened


def mesh_pixels(picture):
    """Where the mesh is, left of the panel: coloured and not the white of the page."""
    part = picture[:, :660]
    return (part.max(axis=2) - part.min(axis=2) > 30) & (part.min(axis=2) < 200)


def yellow_height(picture):
    """Mean row of the yellow pixels, which are the best surface."""
    r, g, b = np.moveaxis(picture[:, :660], 2, 0)
    rows, _ = np.nonzero((r > 150) & (g > 150) & (b < 120))
    assert len(rows) > 30
    return rows.mean()


@pytest.mark.long
def test_dragging_the_anchor_moves_colours_and_triple(viewer, page, tmp_path_factory):
    before, text = shot(page), page.inner_text("body")
    anchor = np.array(viewer.settings.anchor)
    reach = 0.6 * viewer.anchor.scale
    start = on_screen(viewer.server, anchor + np.array([0, 0, reach]))
    end = on_screen(viewer.server, anchor + np.array([0, 0, reach + 0.05]))
    assert end[1] < start[1] - 30
    drag(page, start, end)
    wait(lambda: viewer.settings.anchor[2] > 0.03)
    assert viewer.settings.anchor[2] == pytest.approx(0.05, abs=0.01)
    assert np.allclose(viewer.settings.anchor[:2], 0, atol=1e-6), "it moved along its arrow"
    assert viewer.shown.triples.thumb[0][2] > 0.02
    wait(lambda: viewer.shown.describe() in page.inner_text("body").replace("\n", " "))
    assert viewer.shown.describe() not in text
    wait(lambda: yellow_height(shot(page)) < yellow_height(before) - 20)
    page.screenshot(path=tmp_path_factory.getbasetemp() / "viewer.png")
    folder = os.environ.get("MJX_GRASP_SCREENSHOTS")
    if folder:
        page.screenshot(path=os.path.join(folder, "viewer.png"))


@pytest.mark.long
def test_the_width_of_a_named_part_holds_for_that_part_alone(viewer, page):
    field, sigma = control(page, "part or side"), number(page, "sigma [mm]")
    field.fill("by the handle")
    field.press("Enter")
    wait(lambda: float(sigma.input_value()) == 5.0)
    assert viewer.settings.anchor == pytest.approx(HANDLE.at)
    tip = np.array([0, 0, HANDLE.at[2] + 0.6 * viewer.anchor.scale])
    drag(page, *(on_screen(viewer.server, tip - [0, 0, down]) for down in (0.0, 0.03)))
    wait(lambda: viewer.settings.anchor[2] < 0.03)
    wait(lambda: float(sigma.input_value()) == 30.0)
    assert viewer.settings.sigma is None


@pytest.mark.long
def test_the_panel_changes_sigma_triples_and_place(viewer, page):
    field = control(page, "part or side")
    field.fill("the bottom")
    field.press("Enter")
    wait(lambda: viewer.settings.anchor == pytest.approx((0.0, 0.0, -0.08), abs=1e-6))
    wait(lambda: "anchor (0.0, 0.0, -80.0) mm" in page.inner_text("body"))
    wait(lambda: viewer.shown.triples.thumb[0][2] < -0.03)
    field.fill("by the trunk")
    field.press("Enter")
    wait(lambda: "no known part or side" in page.inner_text("body"))
    before = viewer.shown.best
    sigma = number(page, "sigma [mm]")
    sigma.fill("5")
    sigma.press("Enter")
    wait(lambda: viewer.settings.sigma == pytest.approx(0.005))
    wait(lambda: viewer.shown.best < before)


@contextmanager
def served(stored, target=None, **settings):
    need_viser()
    from mjx_grasp.viz.viewer import Viewer

    made = Viewer(stored[0], target or stored[1], ViewerSettings(**settings), port=free_port())
    try:
        yield made
    finally:
        made.close()


def test_a_width_of_ones_own_holds_until_the_object_changes(stored):
    with served(stored) as viewer:
        viewer.sigma.value = 12.0  # as from the page, callbacks run
        viewer.instruction.value = "by the handle"
        viewer.steered.value = False
        assert viewer.settings.sigma == pytest.approx(0.012) and viewer.sigma.value == 12.0
        viewer.change(*stored)
        assert viewer.settings.sigma is None and viewer.sigma.value == 30.0


@pytest.mark.parametrize("millimetres", [0.04, 100.0])
def test_any_width_can_be_asked_for(stored, millimetres):
    with served(stored, sigma=1e-3 * millimetres) as viewer:
        assert viewer.sigma.value == pytest.approx(millimetres)
        assert 0 < viewer.sigma.min <= 1.0 and viewer.sigma.max >= 60.0
        viewer.sigma.value = 20.0
        assert viewer.settings.sigma == pytest.approx(0.02)
        viewer.change(*stored)
        assert viewer.settings.sigma == 1e-3 * millimetres
        assert viewer.sigma.value == pytest.approx(millimetres)


def test_the_slider_reaches_the_width_of_a_large_part(stored):
    large = replace(stored[1], parts={"handle": HANDLE._replace(size=(0.8, 0.8, 0.8))})
    with served(stored, large) as viewer:
        viewer.instruction.value = "by the handle"
        assert viewer.sigma.value == viewer.sigma.max == pytest.approx(100.0)
        assert viewer.settings.sigma is None


@pytest.mark.long
def test_without_the_anchor_it_is_the_default_heatmap(viewer, page, stored):
    box = control(page, "anchor")
    box.uncheck()
    # The settings change first, what is shown a moment later.
    wait(lambda: np.array_equal(viewer.shown.score, stored[0].heatmap.score))
    assert viewer.settings.anchor is None
    wait(lambda: "anchor (" not in page.inner_text("body"))
    box.check()
    wait(lambda: viewer.settings.anchor is not None)


@pytest.mark.long
def test_the_command_serves_and_ends(stored, tmp_path):
    need_viser()
    path = tmp_path / "box.npz"
    save_heatmap(path, stored[0].heatmap, stored[0].faces, stored[0].info)
    command = [sys.executable, "-m", "mjx_grasp.view", str(path), "--port", str(free_port())]
    # Started in the background, the tests ignore interrupts, and what they start would too.
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        line = next(line for line in process.stdout if "shows box" in line)
        with urllib.request.urlopen(line.split()[0], timeout=20) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130
        assert "Traceback" not in process.stderr.read()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["none.obj"], "none.obj"),
        (["none.npz"], "no such file"),
        (["none.obj", "--port", "0"], "--port"),
        (["none.obj", "--sigma", "0"], "sigma"),
        (["none.obj", "--triples", "9"], "1 to 8"),
        (["none.obj", "--host", "999.1.1.1"], "--host: found '999.1.1.1'"),
        (["none.obj", "--host", "192.0.2.1"], "an address of this machine"),
    ],
)
def test_mistakes_are_refused(arguments, text, monkeypatch, capsys):
    need_viser()
    status, error = refusal(monkeypatch, capsys, "view", *arguments)
    assert status == 2 and text in error


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "localhost"])
def test_addresses_of_this_machine_can_be_served_on(host):
    check_host(host)


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch):
    from mjx_grasp.viz.viewer import import_viser

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"mjx_grasp\[viewer\]"):
        import_viser()
