"""The live page: the heatmap viewer with robot and table around the object, and a button.

What the page asks for is done one after the other in one thread, which owns the grasp; another
compiles meanwhile. Needs the extra ``viewer`` (viser).
"""

from __future__ import annotations

import queue
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.heatmap.files import StoredHeatmap
from mjx_grasp.language.grounding import Target, target_of
from mjx_grasp.objects.meshes import EXTENSIONS
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.known import known_object, steered_candidates
from mjx_grasp.pipeline.state import Known
from mjx_grasp.sim.scene import OBJECT_BODY, TABLE_GEOM
from mjx_grasp.viz.demo.plots import FINGERS
from mjx_grasp.viz.links import geom_mesh, links
from mjx_grasp.viz.live import LiveGrasp
from mjx_grasp.viz.live_status import note, status
from mjx_grasp.viz.pace import Pace
from mjx_grasp.viz.viewer import Viewer
from mjx_grasp.viz.viewer_state import ViewerSettings

MOST_PUSH_N = 5.0
_DRAW_EVERY = 5  # ticks: 20 pictures per second
_CAMERA = np.array([1.46, -0.82, 0.74]), np.array([0.33, -0.03, 0.25])
_FOV = 0.75  # rad
_AMBIENT = 0.4
_TABLE, _PUSH = (205, 194, 178), (230, 120, 30)

_HOW = "tick anchor and drag it to where the grasp should be, or leave it; then press grasp"


class Subject(NamedTuple):
    """An object with what a grasp and a page need of it."""

    stored: StoredHeatmap
    target: Target
    known: Known


class LiveViewer:
    """Serves the page until it is closed; see `Viewer` for the heatmap's own part of it.

    Args:
        live: The grasp, of a scene with all objects.
        heatmap: Computes the heatmap of an object.
        load: Makes an object of a mesh's file, for meshes that are dropped on the page; None: none
            can be.
        settings: What is shown first.
        host: Address to serve on.
        port: Port to serve on; the next free one if it is taken.

    Raises:
        InputError: The extra is not installed.
    """

    def __init__(
        self,
        live: LiveGrasp,
        heatmap: Callable[[ObjectModel], StoredHeatmap],
        settings: ViewerSettings | None = None,
        load: Callable[[Path], ObjectModel] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        self.live, self._heatmap, self._load = live, heatmap, load
        self._seed = 0  # of where objects are put
        self._objects = {obj.name: obj for obj in live.scene.objects}
        self._subjects: dict[str, Subject] = {}
        self._name = next(iter(self._objects))
        self._data = mujoco.MjData(live.scene.model)
        subject = self._subject(self._name)
        self.viewer = Viewer(subject.stored, subject.target, settings, host, port)
        self.viewer.camera, self.viewer.fov = _CAMERA, _FOV
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._stopped, self._closed = threading.Event(), threading.Event()
        self._asked = threading.Lock()  # held while a grasp is queued or runs
        self._ready, self._hint = False, "getting ready"
        self._build_scene()
        self._build_panel()
        self._put()
        self._threads = [
            threading.Thread(target=each, daemon=True) for each in (self._prepare, self._work)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return self.viewer.url

    @property
    def push(self) -> Float[np.ndarray, " 3"]:
        """The force of the sliders, world frame [N]."""
        angle = np.deg2rad(self.towards.value)
        return float(self.force.value) * np.array([np.cos(angle), np.sin(angle), 0.0])

    def close(self) -> None:
        """Ends what runs, then stops serving."""
        self._closed.set()
        self._stopped.set()
        self._jobs.put(None)
        self._threads[1].join(5.0)
        self.live.close()
        self.viewer.close()

    def _build_scene(self) -> None:
        server, model = self.viewer.server, self.live.scene.model
        scene = server.scene
        # Less even than around the object alone: a robot without shades is hard to make out.
        scene.add_light_ambient("/light", intensity=_AMBIENT)
        table = geom_mesh(model, model.geom(TABLE_GEOM).id)
        scene.add_mesh_simple("/table", table.vertices, table.faces, color=_TABLE)
        bodies = [b for b in range(1, model.nbody) if model.body(b).name != OBJECT_BODY]
        self._links: dict[int, Any] = {}
        for k, (body, mesh, colour) in enumerate(links(model, bodies)):
            name = f"/robot/{body}"
            if body not in self._links:
                self._links[body] = scene.add_frame(name, show_axes=False)
            scene.add_mesh_simple(
                f"{name}/{k}", mesh.vertices, mesh.faces, color=tuple(colour.tolist())
            )
        self._contacts = [
            scene.add_icosphere(f"/contact/{name}", 0.005, _rgb(colour), visible=False)
            for name, colour in FINGERS
        ]
        self._arrow = scene.add_frame("/push", show_axes=False, visible=False)

    def _build_panel(self) -> None:
        gui = self.viewer.server.gui
        with gui.add_folder("grasp", order=-1.0):
            self.chosen = gui.add_dropdown("object", tuple(self._objects))
            self.upload = gui.add_upload_button(
                "mesh of your own", disabled=True, color="gray", visible=self._load is not None,
                mime_type=",".join(EXTENSIONS), hint=f"in metres: {', '.join(EXTENSIONS)}",
            )  # fmt: skip
            self.grasp = gui.add_button("grasp", disabled=True, color="blue")
            self.stop = gui.add_button("stop", disabled=True, color="gray")
            self.drop = gui.add_button("new pose", color="gray")
            self.force = gui.add_slider("push [N]", 0.0, MOST_PUSH_N, 0.1, 0.0)
            self.towards = gui.add_slider("towards [°]", -180, 180, 5, 90)
            self._status = gui.add_html(note(self._hint))
        self.grasp.on_click(lambda _: self._ask())
        self.drop.on_click(lambda _: self._jobs.put(self._drop))
        self.stop.on_click(lambda _: self._stopped.set())
        self.upload.on_upload(lambda event: self._receive(event.target.value))
        for slider in (self.force, self.towards):
            slider.on_update(lambda _: self._draw_push())

        @self.chosen.on_update
        def _(_event: Any) -> None:
            name = self.chosen.value
            self._jobs.put(lambda: self._choose(name))

    def _ask(self) -> None:
        """Has a grasp done, unless one is queued or runs."""
        if self._asked.acquire(blocking=False):
            self._stopped.clear()
            self._jobs.put(self._answer)

    def _answer(self) -> None:
        try:
            self._grasp()
        finally:
            self._asked.release()

    def _work(self) -> None:
        """Does what is asked for, in its order."""
        while (job := self._jobs.get()) is not None and not self._closed.is_set():
            self._enable(running=True)
            try:
                job()
            except Exception as error:  # the page has to say so, and go on
                self._say(f"{type(error).__name__}: {error}")
            self._enable(running=False)

    def _prepare(self) -> None:
        """Compiles, and says so."""
        at = [self._hint]
        try:
            with self._counting(at):
                self.live.prepare(self._subjects[self._name].known, at.append)
        except Exception as error:
            self._hint = f"{type(error).__name__}: {error}"
            self._say(self._hint)
            raise
        self._ready, self._hint = True, _HOW
        self._say(f"ready: {_HOW}")
        self._enable(running=not self._jobs.empty())

    @contextmanager
    def _counting(self, at: list[str]) -> Iterator[None]:
        """Says every second what is worked on, the last of a list, until it is done."""
        began, done = time.monotonic(), threading.Event()

        def count() -> None:
            while not (done.wait(1.0) or self._closed.is_set()):
                seconds = time.monotonic() - began
                self._say(f"{at[-1]}, {seconds:.0f} s; a minute or two in all")

        counter = threading.Thread(target=count, daemon=True)
        counter.start()
        try:
            yield
        finally:
            done.set()
            counter.join()

    def _subject(self, name: str) -> Subject:
        if name not in self._subjects:
            obj, robot = self._objects[name], self.live.scene.robot
            stored = self._heatmap(obj)
            # Steered like every grasp here: of one size, so that nothing is compiled again.
            known = known_object(obj, robot, stored.heatmap, stored.heatmap.score)
            target = target_of(obj.name, obj.mesh, obj.parts)
            self._subjects[name] = Subject(stored, target, known)
        return self._subjects[name]

    def _choose(self, name: str) -> None:
        if name != self._name:
            if name not in self._subjects:
                self._say(f"computing the heatmap of {name}")
            subject, self._name = self._subject(name), name
            self.viewer.change(subject.stored, subject.target)
            self._put()
            self._say(f"{name}: {self._hint}")

    def _receive(self, file: Any) -> None:
        """Has a mesh added that was dropped on the page: its name and its bytes."""
        name, content = str(file.name), bytes(file.content)
        self._jobs.put(lambda: self._add(name, content))

    def _add(self, file: str, content: bytes) -> None:
        """Makes an object of a mesh, has everything compiled for it, and chooses it.

        Raises:
            FileError, InputError: It is no mesh that can be grasped, or its name is there already.
        """
        assert self._load is not None
        self._say(f"working out the shape of {file}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / Path(file).name
            path.write_bytes(content)
            try:
                obj = self._load(path)
            except FileError as error:  # the page knows no folder
                raise FileError(file, error.found, error.expected) from None
        live = self.live.with_more(obj)
        at = [f"computing the heatmap of {obj.name}"]
        with self._counting(at):
            self._objects[obj.name] = obj
            try:
                live.prepare(self._subject(obj.name).known, at.append)
            except Exception:
                del self._objects[obj.name]
                self._subjects.pop(obj.name, None)
                raise
        before, self.live = self.live, live
        before.close()
        self._data = mujoco.MjData(live.scene.model)
        self.chosen.options = tuple(self._objects)
        self.chosen.value = obj.name
        self._choose(obj.name)
        self._say(f"{obj.name}, {1e3 * obj.mass:.0f} g: {self._hint}")

    def _drop(self) -> None:
        self._seed += 1
        self._put()
        self._say(f"{self._name}: {self._hint}")

    def _put(self) -> None:
        """Robot home, the object at a random resting pose."""
        index = self.live.scene.object_index(self._name)
        problem = draw_problem(self.live.scene, 1, self._seed, objects=[index])
        self.live.put(index, problem.p_wo[0], problem.quat[0])
        self._show_marks(running=False)
        self._draw()

    def _grasp(self) -> None:
        """One grasp from beginning to end, in real time or slower."""
        score = np.asarray(self.viewer.shown.score)
        if not self._ready or score.max() <= 0:
            self._say("this hand can grasp nothing there" if self._ready else "not ready yet")
            return
        subject = self._subjects[self._name]
        obj = self._objects[self._name]
        candidates = steered_candidates(subject.stored.heatmap, score, obj=obj)
        self._say("planning")
        self.live.start(subject.known._replace(candidates=candidates))
        self._show_marks(running=True)
        self._draw()
        pace, ticks = Pace(self.live.grasper.dt), 0
        while not self.live.done and not self._stopped.is_set():
            pace.wait()
            self.live.tick(self.push)
            ticks += 1
            if ticks % _DRAW_EVERY == 0:
                self._draw(pace.rate)
        self._draw(pace.rate, stopped=self._stopped.is_set())
        if self.live.last is None:
            self._say("stopped")  # while it was planned
        self.live.stop()
        self._show_marks(running=False)

    def _show_marks(self, running: bool) -> None:
        """The heatmap's own marks, or while a grasp runs the three points that it goes for."""
        self.viewer.show_marks(not running)
        for mark in self._contacts:
            mark.visible = running

    def _enable(self, running: bool) -> None:
        self.grasp.disabled = running or not self._ready
        self.stop.disabled = not running
        self.drop.disabled = self.chosen.disabled = running
        self.upload.disabled = running or not self._ready

    def _say(self, text: str) -> None:
        self._status.content = note(text)

    def _draw(self, pace: float = 1.0, stopped: bool = False) -> None:
        """Puts robot, object and words where they are, all at once."""
        model, data, last = self.live.scene.model, self._data, self.live.last
        data.qpos[:] = self.live.qpos
        mujoco.mj_kinematics(model, data)
        with self.viewer.server.atomic():
            for body, frame in self._links.items():
                frame.position, frame.wxyz = data.xpos[body].copy(), data.xquat[body].copy()
            self.viewer.place(*self.live.object_pose)
            self._arrow.position = self.live.object_pose[0]
            if last is not None:
                for mark, point in zip(self._contacts, last.contacts, strict=True):
                    mark.position = point
                self._status.content = status(last, pace, stopped)

    def _draw_push(self) -> None:
        """An arrow that ends at the object, the longer the harder it pushes."""
        push = self.push
        force = float(np.linalg.norm(push))
        self._arrow.visible = force > 0
        if force > 0:
            reach = 0.5 * float(np.linalg.norm(self._objects[self._name].mesh.extents))
            end = -reach * push / force
            self.viewer.server.scene.add_arrows(
                "/push/arrow", np.stack([end - 0.04 * push - 0.03 * push / force, end])[None],
                colors=_PUSH, shaft_radius=0.004, head_radius=0.010, head_length=0.020,
            )  # fmt: skip


def _rgb(colour: str) -> tuple[int, int, int]:
    """A colour such as ``#c03a26``."""
    r, g, b = bytes.fromhex(colour.removeprefix("#"))
    return r, g, b
