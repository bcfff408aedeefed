"""A live grasp without a browser: its physics, its ends, its pace, and the page's own thread."""

import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import handmade
import numpy as np
import pytest
from browser import free_port, need_viser, wait

from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import REACTING, CloserConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.files import HeatmapInfo, StoredHeatmap
from mjx_grasp.objects.config import Weight
from mjx_grasp.objects.resting import RestingPose
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.reaching.config import HandoffGate
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.live import LiveGrasp
from mjx_grasp.viz.live_status import status
from mjx_grasp.viz.live_tick import LiveTick, advance
from mjx_grasp.viz.pace import Pace

HERE, UPRIGHT = np.array([0.5, -0.1, 0.0451]), np.array([1.0, 0.0, 0.0, 0.0])
THERE, LYING = np.array([0.5, 0.1, 0.0201]), np.array([0.5**0.5, 0.5**0.5, 0.0, 0.0])
IN_THE_AIR = np.array([0.5, -0.1, 0.3])


@pytest.fixture(scope="module")
def objects():
    """A box that stands and one that lies; their meshes are the same, to compile less."""
    poses = RestingPose(UPRIGHT, HERE[2], 1.0), RestingPose(LYING, THERE[2], 1.0)
    names = "standing", "lying"
    return [
        replace(handmade.box(name), resting=(pose,))
        for name, pose in zip(names, poses, strict=True)
    ]


@pytest.fixture(scope="module")
def live(robot, body, objects):
    """Closes at once wherever it is, and soon finds that nothing is there."""
    settings = reach_preset("paper")
    fields = replace(settings.reach.fields, via_points=4)
    control = replace(settings.reach.controller, gate=HandoffGate(midpoint=10.0))
    reach = replace(settings.reach, fields=fields, controller=control)
    closer = Closer.of(robot, CloserConfig(grip=REACTING))
    config = GrasperConfig(lost=float("inf"), contact_s=0.2, retries=0)
    grasper = Grasper.of(Reacher(body, reach, settings.selection), closer, config)
    made = LiveGrasp(grasper, NativePhysics(build_scene(objects, robot), grasper.dt, threads=1))
    yield made
    made.close()


def heatmap(obj):
    mesh = obj.mesh.subdivide_to_size(0.03)
    found = compute_heatmap(mesh.vertices, mesh.faces, None, (0.02, 0.09), 0.5)
    info = HeatmapInfo(obj.name, (0.02, 0.09), 0.5, (0.0, 0.0, 0.0))
    return StoredHeatmap(found, np.asarray(mesh.faces), info)


@pytest.fixture(scope="module")
def known(robot, objects):
    return [known_object(obj, robot, heatmap(obj).heatmap) for obj in objects]


def run(live, most=200):
    ticks = []
    while not live.done and len(ticks) < most:
        ticks.append(live.tick())
    return ticks


@pytest.mark.long
def test_a_grasp_that_finds_nothing_says_why_and_ends(live, known):
    live.put(0, HERE, UPRIGHT)
    assert live.done and live.last is None
    live.start(known[0])
    assert not live.done
    ticks = run(live)
    first, last = ticks[0], ticks[-1]
    assert first.phase == Phase.CLOSING and first.outcome is None
    assert (last.phase, last.failure) == (Phase.FAILED, Failure.NO_CONTACT)
    assert last.outcome == "too few fingers found contact"
    assert last.clock == pytest.approx(0.01 * len(ticks), abs=1e-4)
    assert 1.15 < last.clock < 1.3, "closing, then a second in which things may fall"
    np.testing.assert_allclose(live.object_pose[0], HERE, atol=2e-3)
    np.testing.assert_array_equal(live.qpos, last.qpos)


@pytest.mark.long
def test_a_push_moves_the_object_and_the_next_grasp_begins_where_it_came_to_lie(live, known):
    live.put(0, HERE, UPRIGHT)
    live.start(known[0])
    for _ in range(12):
        live.tick(np.array([0.0, 3.0, 0.0]))
    for _ in range(60):
        live.tick()
    moved = live.object_pose[0] - HERE
    assert moved[1] > 0.03 and abs(moved[0]) < 0.01
    lies = live.object_pose[0]
    live.stop()
    assert live.done
    live.start(known[0])
    np.testing.assert_allclose(live.object_pose[0], lies, atol=1e-6)
    np.testing.assert_allclose(
        live.qpos[live.scene.addresses.robot_qpos], live.grasper.reacher.body.home, atol=1e-6
    )


@pytest.mark.long
def test_what_is_in_the_air_is_put_back(live, known):
    live.put(0, IN_THE_AIR, UPRIGHT)
    live.start(known[0])
    for _ in range(15):
        live.tick()
    assert 0.05 < live.object_pose[0][2] < 0.25, "it falls"
    live.start(known[0])
    np.testing.assert_allclose(live.object_pose[0], IN_THE_AIR, atol=1e-6)


@pytest.mark.long
def test_one_compiled_tick_serves_all_objects(live, known):
    live.put(0, HERE, UPRIGHT)
    live.start(known[0])
    live.tick()
    before = advance._cache_size()
    live.put(1, THERE, LYING)
    live.start(known[1])
    live.tick()
    live.prepare(known[1])
    assert advance._cache_size() == before
    live.tick()
    np.testing.assert_allclose(live.object_pose[0], THERE, atol=1e-3)


def test_ticks_keep_their_distance_and_lost_time_is_not_caught_up():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    pace = Pace(0.01, lambda: now[0], sleep)
    begun = []
    for work in [0.004] * 100 + [0.5] + [0.004] * 100:
        pace.wait()
        begun.append(now[0])
        now[0] += work
    gaps = np.diff(begun)
    assert gaps.min() >= 0.01 - 1e-9 and gaps[:100].max() < 0.01 + 1e-9
    assert gaps[100] == pytest.approx(0.5) and gaps[101:].max() < 0.01 + 1e-9
    assert 0.9 < pace.rate <= 1.0
    for _ in range(300):
        pace.wait()
        now[0] += 0.02
    assert pace.rate == pytest.approx(0.5, abs=0.05)


def tick(phase, failure=Failure.NONE, rise=0.0, success=False):
    three = np.array([0.012, 0.0, 0.003])
    return LiveTick(
        phase=np.array(phase), failure=np.array(failure), clock=np.array(1.23),
        entered=np.zeros(5), qpos=np.zeros(1), speed=np.array(0.0), tip_error=three,
        contacts=np.zeros((3, 3)), touching=three > 0.0, force=1e3 * three,
        rise=np.array(rise), success=np.array(success), plans_due=np.array(False),
    )  # fmt: skip


def test_the_status_says_how_it_stands():
    open_yet = status(tick(Phase.CLOSING), pace=0.5)
    assert "<b>closing</b> at 1.2 s, 0.5 of real time" in open_yet and "12 mm" in open_yet
    assert "held" not in open_yet and "12.0 N" in open_yet
    assert "stopped" in status(tick(Phase.REACHING), stopped=True)
    assert "lifted and held</b>" in status(tick(Phase.HOLDING, rise=0.15, success=True))
    assert "sinking" in status(tick(Phase.HOLDING, rise=0.02, success=True))
    assert "not yet held" in status(tick(Phase.HOLDING, rise=0.15))
    for failure in list(Failure)[1:]:
        failed = tick(Phase.FAILED, failure)
        assert failed.outcome is not None and failed.outcome in status(failed)


@contextmanager
def served(live, ready=True, load=None):
    need_viser()
    from mjx_grasp.viz.live_viewer import LiveViewer

    viewer = LiveViewer(live, heatmap, load=load, port=free_port())
    try:
        if ready:
            wait(lambda: not viewer.grasp.disabled, 60)
        yield viewer
    finally:
        viewer.close()


def test_the_page_runs_one_grasp_after_the_other_without_anybody_looking(live):
    with served(live) as viewer:
        assert viewer.url.startswith("http://127.0.0.1:")
        assert viewer.stop.disabled
        viewer.chosen.value = "lying"  # as from the page, callbacks run
        wait(lambda: live.object_pose[0][2] == pytest.approx(THERE[2]))
        assert viewer.viewer.target.name == "lying"
        where = live.object_pose[0].copy()
        viewer.drop.value = True
        wait(lambda: not np.allclose(live.object_pose[0], where))
        viewer.grasp.value = True
        wait(lambda: "failed" in viewer._status.content, 60)
        wait(lambda: not viewer.grasp.disabled, 60)
        assert "too few fingers" in viewer._status.content and live.done
        viewer.drop.value = True
        wait(lambda: "lying: tick anchor" in viewer._status.content)
        wait(lambda: not viewer.grasp.disabled)
        viewer.grasp.value = True
        wait(lambda: "failed" in viewer._status.content, 60)
    assert not viewer._threads[1].is_alive()


def test_a_mesh_that_is_dropped_on_the_page_is_grasped_like_the_others(live, objects, monkeypatch):
    """And what is none, or has the name of another, changes nothing."""
    monkeypatch.setattr(live, "close", lambda: None)  # others use it
    read = []

    def load(path):
        read.append((path.name, path.read_bytes()))
        if path.suffix != ".stl":
            raise FileError(path, "no mesh", "one that can be grasped")
        return replace(objects[0], name=path.stem)

    def dropped(name, then):
        viewer._receive(SimpleNamespace(name=name, content=b"bytes"))
        wait(lambda: then in viewer._status.content, 120)
        wait(lambda: not viewer.upload.disabled)

    with served(live, load=load) as viewer:
        assert viewer.upload.visible
        dropped("notes.txt", "FileError: notes.txt: found no mesh, expected one")
        dropped("lying.stl", "a name that is not there (standing, lying)")
        assert viewer.chosen.options == ("standing", "lying") and viewer.live is live
        dropped("../mine.stl", "mine, ")
        assert read[-1] == ("mine.stl", b"bytes")
        assert viewer.chosen.options == ("standing", "lying", "mine")
        assert viewer.chosen.value == viewer.viewer.target.name == "mine"
        assert viewer.live.scene.object_names == ("standing", "lying", "mine")
        viewer.grasp.value = True
        wait(lambda: "failed" in viewer._status.content, 60)
        wait(lambda: not viewer.grasp.disabled)
        viewer.chosen.value = "lying"
        wait(lambda: viewer.live.object_pose[0][2] == pytest.approx(THERE[2]))
    with served(live, ready=False) as viewer:
        assert not viewer.upload.visible


def test_what_meshes_weigh_may_be_of_dropped_ones_alone(tmp_path, monkeypatch):
    """Of the catalogue's objects it is refused elsewhere."""
    from mjx_grasp.viz import viewing

    weights = []
    nothing = SimpleNamespace(dt=0.01)
    for name in ("loaded_grasper", "build_scene", "NativePhysics", "LiveGrasp"):
        monkeypatch.setattr(viewing, name, lambda *_, **__: nothing)
    monkeypatch.setattr(viewing, "closing_policy", lambda *_: None)
    monkeypatch.setattr(viewing, "load_objects", lambda *_, weight: weights.append(weight))
    mesh = tmp_path / "jug.stl"
    handmade.box("jug").mesh.export(mesh)
    config = viewing.ViewConfig(Path("mug"), live=True, mass=0.2)
    viewing.load_live(config)
    viewing.load_live(replace(config, also=(str(mesh),)))
    assert weights == [None, Weight(0.2, None)]
    assert viewing.own_object(config, mesh).mass == pytest.approx(0.2)


def test_a_grasp_that_is_stopped_while_it_is_planned_ends_and_says_so(live, monkeypatch):
    begun, planned, start = [], threading.Event(), live.start

    def slow(known):
        begun.append(known)
        planned.wait(20.0)
        start(known)

    monkeypatch.setattr(live, "start", slow)
    with served(live) as viewer:
        viewer.grasp.value = True
        wait(lambda: begun)
        assert "planning" in viewer._status.content
        viewer.stop.value = True
        viewer.grasp.value = True  # a second click, which is neither queued nor ends the stop
        planned.set()
        wait(lambda: "stopped" in viewer._status.content)
        wait(lambda: not viewer.grasp.disabled)
        assert len(begun) == 1 and live.done and live.last is None
        viewer.grasp.value = True
        wait(lambda: "failed" in viewer._status.content, 60)
        assert len(begun) == 2


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_why_it_cannot_be_prepared_stays_on_the_page(live, monkeypatch):
    def failing(known, tell):
        tell("compiling the planner")
        time.sleep(1.5)
        raise RuntimeError("no such device")

    monkeypatch.setattr(live, "prepare", failing)
    with served(live, ready=False) as viewer:
        wait(lambda: "compiling the planner, 1 s" in viewer._status.content)
        wait(lambda: "no such device" in viewer._status.content)
        time.sleep(1.5)
        assert "RuntimeError: no such device" in viewer._status.content
        viewer.drop.value = True
        wait(lambda: "standing: RuntimeError" in viewer._status.content)
        assert viewer.grasp.disabled


def test_that_it_is_ready_stays_on_the_page(live, monkeypatch):
    need_viser()
    from mjx_grasp.viz.live_viewer import LiveViewer

    say = LiveViewer._say

    def slow(viewer, text):
        if " s; " in text:  # how long it has taken, which comes late
            time.sleep(1.4)
        say(viewer, text)

    monkeypatch.setattr(LiveViewer, "_say", slow)
    monkeypatch.setattr(live, "prepare", lambda known, tell: time.sleep(1.1))
    with served(live) as viewer:
        for _ in range(20):
            assert "ready: " in viewer._status.content
            time.sleep(0.1)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1"])
def test_the_live_page_is_for_this_machine_alone(host):
    need_viser()
    from mjx_grasp.viz.viewing import check_loopback

    check_loopback("127.0.0.1")
    check_loopback("localhost")
    with pytest.raises(InputError, match="--host"):
        check_loopback(host)
