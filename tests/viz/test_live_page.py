"""The live page as somebody uses it: choose, drag, grasp, push, in a real browser."""

import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from browser import browsing, control, drag, free_port, need_viser, number, on_screen, wait

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
    from mjx_grasp.viz.viewing import ViewConfig, object_heatmap

    settings = whole_grasps(steered=True)
    plan = replace(settings.plan, library=4000)
    grasper = grasper_of(robot, reaching=replace(settings, plan=plan))
    objects = [load_object(name) for name in ("tomato_soup_can", "rubiks_cube")]
    live = LiveGrasp(grasper, NativePhysics(build_scene(objects, robot), grasper.dt, threads=1))
    heatmap = partial(object_heatmap, ViewConfig(Path("mesh"), live=True))
    made = LiveViewer(live, heatmap, ViewerSettings(), port=free_port())
    yield made
    made.close()


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

    def keep(name):
        for folder in filter(None, (tmp_path, os.environ.get("MJX_GRASP_SCREENSHOTS"))):
            page.screenshot(path=Path(folder) / name)
        print(tmp_path / name)

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
        keep("live_steered.png")

        page.get_by_role("button", name="grasp", exact=True).click()
        seen = []

        def follow(until):
            now = phase()
            if now and seen[-1:] != [now]:
                seen.append(now)
            return until()

        wait(lambda: follow(lambda: phase() in ("holding", "failed")), 120)
        assert set(seen) & {"reaching", "closing", "lifting"}, "it was watched"
        field = number(page, "push [N]")
        field.fill("1.5")
        field.press("Enter")
        wait(lambda: np.linalg.norm(viewer.push) == pytest.approx(1.5))
        wait(lambda: "lifted and held" in words() or phase() == "failed", 60)
        keep("live.png")
        assert seen[-1] == "holding" and viewer.live.last.rise > 0.1
        page.get_by_role("button", name="stop", exact=True).click()
        wait(lambda: viewer.live.done)
        wait(lambda: "stopped" in words())
    wait(lambda: not viewer.grasp.disabled)
