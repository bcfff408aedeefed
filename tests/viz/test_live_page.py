"""The live page as somebody uses it: choose, drag, grasp, push, in a real browser."""

import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from browser import browsing, control, drag, free_port, need_viser, on_screen, slide, wait

from mjx_grasp.geometry import so3
from mjx_grasp.objects.model import load_object
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.live import LiveGrasp
from mjx_grasp.viz.viewer_state import ViewerSettings

SIZE = {"width": 1280, "height": 800}
PHASE = re.compile(r"(reaching|closing|lifting|holding|failed) at [\d.]+ s")


@pytest.fixture(scope="module")
def viewer(robot):
    """With fewer postures to start from than the command's."""
    need_viser()
    from mjx_grasp.viz.live_viewer import LiveViewer
    from mjx_grasp.viz.viewing import ViewConfig, object_heatmap, own_object

    settings = whole_grasps(steered=True)
    plan = replace(settings.plan, library=4000)
    grasper = grasper_of(robot, reaching=replace(settings, plan=plan))
    objects = [load_object(name) for name in ("tomato_soup_can", "rubiks_cube")]
    live = LiveGrasp(grasper, NativePhysics(build_scene(objects, robot), grasper.dt, threads=1))
    config = ViewConfig(Path("mesh"), live=True, mass=0.15)
    heatmap, own = partial(object_heatmap, config), partial(own_object, config)
    made = LiveViewer(live, heatmap, ViewerSettings(), own, port=free_port())
    yield made
    made.close()


def keep(page, folder, name):
    for kept in filter(None, (folder, os.environ.get("MJX_GRASP_SCREENSHOTS"))):
        page.screenshot(path=Path(kept) / name)
    print(folder / name)


def stops(page, live):
    """Stops a grasp, unless it has ended by itself, after seconds of holding; whether it did."""
    from playwright.sync_api import TimeoutError as TooLong

    try:
        page.get_by_role("button", name="stop", exact=True).click()
    except TooLong:
        assert live.done
        return False
    wait(lambda: live.done)
    return True


@pytest.mark.long
def test_choose_drag_grasp_and_push(viewer, tmp_path):
    def words():
        return page.inner_text("body")

    def phase():
        found = PHASE.search(words())
        return found and found.group(1)

    def in_world(point):
        p_wo, quat = viewer.live.object_pose
        return p_wo + np.asarray(so3.quat_to_mat(jnp.asarray(quat))) @ point

    with browsing(viewer.url, SIZE) as page:
        wait(lambda: "compiling" in words() or "drawing" in words(), 60)
        if (warning := page.locator(".mantine-Notification-closeButton")).count():
            warning.first.click()  # that the browser draws without a GPU
        box = control(page, "anchor")
        box.check()
        wait(lambda: viewer.viewer.settings.anchor is not None)
        control(page, "object").click()
        page.get_by_role("option", name="rubiks_cube").click()
        wait(lambda: viewer.viewer.target.name == "rubiks_cube", 60)
        wait(lambda: not viewer.grasp.disabled, 400)

        wait(lambda: viewer.viewer.settings.anchor is None and not box.is_checked())
        box.check()
        wait(lambda: viewer.viewer.settings.anchor is not None)
        anchor, best = np.array(viewer.viewer.settings.anchor), viewer.viewer.shown.describe()
        # Along an arrow of its own, towards an edge of the cube.
        reach, far = 0.6 * viewer.viewer.anchor.scale, 0.02
        ends = [in_world(anchor + np.array([0, 0, z])) for z in (reach, reach + far)]
        drag(page, *(on_screen(viewer.viewer.server, end, SIZE) for end in ends))
        wait(lambda: viewer.viewer.settings.anchor[2] > 0.5 * far)
        wait(lambda: viewer.viewer.shown.describe() != best)
        keep(page, tmp_path, "live_steered.png")

        page.get_by_role("button", name="grasp", exact=True).click()
        seen = []

        def over():
            now = phase()
            if now and seen[-1:] != [now]:
                seen.append(now)
            return now in ("holding", "failed")

        wait(over, 120)
        assert set(seen) & {"reaching", "closing", "lifting"}, "it was watched"
        slide(page, "push [N]", 0.3)
        wait(lambda: np.linalg.norm(viewer.push) == pytest.approx(1.5, abs=0.3))
        wait(lambda: "lifted and held" in words() or phase() == "failed", 60)
        keep(page, tmp_path, "live.png")
        assert seen[-1] == "holding" and viewer.live.last.rise > 0.1
        if stops(page, viewer.live):
            wait(lambda: "stopped" in words())
    wait(lambda: not viewer.grasp.disabled)


@pytest.mark.long
def test_a_mesh_of_ones_own_is_dropped_and_grasped(viewer, tmp_path):
    mesh, broken = tmp_path / "carton.stl", tmp_path / "broken.stl"
    trimesh.creation.box(extents=(0.05, 0.06, 0.09)).export(mesh)  # which does not roll
    broken.write_text("no mesh")
    viewer.force.value = 0.0  # of another test

    def words():
        return page.inner_text("body")

    with browsing(viewer.url, SIZE) as page:
        wait(lambda: not viewer.upload.disabled, 400)
        files = page.locator("input[type=file]")
        files.set_input_files(broken)
        wait(lambda: "FileError: broken.stl" in words(), 60)
        wait(lambda: not viewer.upload.disabled)
        files.set_input_files(mesh)
        wait(lambda: "carton.stl, 150 g" in words(), 400)
        assert viewer.viewer.target.name == "carton.stl"
        wait(lambda: not viewer.grasp.disabled)
        if (warning := page.locator(".mantine-Notification-closeButton")).count():
            warning.first.click()
        page.get_by_role("button", name="grasp", exact=True).click()
        wait(lambda: re.search("lifted and held|failed at", words()), 120)
        assert "failed at" not in words() and viewer.live.last.success
        keep(page, tmp_path, "live_own.png")
        stops(page, viewer.live)
