"""A viewer in the browser: the heatmap on the mesh, an anchor to drag, triples that follow live.

Needs the extra ``viewer`` (viser), which is imported when a viewer is made.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from types import ModuleType
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.files import StoredHeatmap
from mjx_grasp.heatmap.steering import Steering
from mjx_grasp.language.grounding import GroundingError, Target
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.viz.glb import coloured_glb
from mjx_grasp.viz.heatmap import THUMB, WRAP
from mjx_grasp.viz.viewer_state import MOST_TRIPLES, Shown, ViewerSettings, show

_PARTS = ("thumb", "index", "middle")
_OBJECT, _TRIPLES = "/object", "/object/triple"  # all on the object moves with its frame
_GIZMO = 0.35  # size of what is dragged, of the mesh's diagonal
_FINGER = 0.15  # length of the lines outside the contacts, of the mesh's diagonal
_WRAP_LINE, _INK, _GREY = (90, 95, 110), (40, 40, 50), (190, 190, 198)
_ANCHOR = "whether grasps are steered to a point, which you drag"
_SIGMA = "distance from the anchor at which a grasp's score falls to 1/e; less keeps it nearer"
_NEAR = (
    "what of a grasp has to be near the anchor: all three contacts, the axis from the thumb to the "
    "fingers (the publication's way), or the middle between the contacts"
)
_PLACE = "moves the anchor to a part or a side in words: by the handle, the top, …"


def import_viser() -> ModuleType:
    """The viser package.

    Raises:
        InputError: The extra is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError("extra", f"no {error.name}", "pip install 'mjx_grasp[viewer]'") from error
    return viser


class Viewer:
    """Serves one heatmap; the page follows until the object is closed.

    Args:
        stored: The heatmap and its mesh.
        target: The object, for instructions.
        settings: What is shown first.
        host: Address to serve on.
        port: Port to serve on; the next free one if it is taken.

    Raises:
        InputError: The extra is not installed.
    """

    def __init__(
        self,
        stored: StoredHeatmap,
        target: Target,
        settings: ViewerSettings | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        viser = import_viser()
        self.settings = settings or ViewerSettings()
        self._first_sigma = self.settings.sigma
        self._take(stored, target)
        self._lock = threading.Lock()  # callbacks come from several threads
        eye = self._centre + self._size * np.array([0.5, -0.8, 0.45])
        self.camera = eye, self._centre
        """where a page that is opened looks from and to, world frame [m]"""
        self.fov = 1.309
        """of its camera, from top to bottom [rad]"""
        self.server = viser.ViserServer(host=host, port=port, verbose=False, label=target.name)
        self._build_scene()
        self._build_panel(stored.info.anchor is not None)
        self._draw()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def close(self) -> None:
        """Stops serving."""
        self.server.stop()

    def set(self, **changes: Any) -> Shown:
        """Changes settings, and with them the page.

        Raises:
            InputError: A setting that cannot work.
        """
        with self._lock:
            before, self.settings = self.settings.scale, replace(self.settings, **changes)
            self.shown = shown = show(self.heatmap, self.settings)
            self._draw()
        if "sigma" not in changes and self.settings.scale != before:
            self._show_sigma()
        return shown

    def change(self, stored: StoredHeatmap, target: Target) -> None:
        """Shows another object in the place of this one, without an anchor, of the first sigma.

        Args:
            stored: Its heatmap and mesh.
            target: It, for instructions.
        """
        with self._lock:
            self.settings = replace(
                self.settings, anchor=None, size=(0.0, 0.0, 0.0), sigma=self._first_sigma
            )
            self._take(stored, target)
            self.anchor.position, self.anchor.scale = self._centre, _GIZMO * self._size
            self._draw_anchor()
            self._draw()
        # Not under the lock, as it calls back.
        self.steered.value = self.anchor.visible = False
        self._show_sigma()
        self.server.gui.set_panel_label(target.name)

    def place(self, position: Float[np.ndarray, " 3"], quat: Float[np.ndarray, " 4"]) -> None:
        """Moves the object with all that is drawn on it.

        Args:
            position: Of its frame in the world [m].
            quat: Its rotation, w-x-y-z.
        """
        self._object.position = position
        self._object.wxyz = quat

    def show_marks(self, visible: bool) -> None:
        """Shows triples and anchor, or hides them."""
        self._triples.visible = visible
        self.anchor.visible = visible and self.settings.anchor is not None

    def _take(self, stored: StoredHeatmap, target: Target) -> None:
        self.heatmap, self.faces, self.target = stored.heatmap, stored.faces, target
        vertices = np.asarray(self.heatmap.vertices).reshape(-1, 3)
        self._size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self._centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self.shown = show(self.heatmap, self.settings)

    def _draw_anchor(self) -> None:
        """The point in the middle of what is dragged."""
        self.server.scene.add_icosphere(
            f"{_OBJECT}/anchor/point", radius=0.018 * self._size, color=(255, 64, 200)
        )

    def _build_scene(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # Even light: shading must not be taken for a score.
        scene.add_light_ambient("/light", intensity=1.0)
        self._object = scene.add_frame(_OBJECT, show_axes=False)
        self._triples = scene.add_frame(_TRIPLES, show_axes=False)
        self._mesh = scene.add_glb(f"{_OBJECT}/mesh", self._glb())
        anchor = self.settings.anchor or tuple(float(x) for x in self._centre)
        self.anchor = scene.add_transform_controls(
            f"{_OBJECT}/anchor", scale=_GIZMO * self._size, disable_rotations=True,
            depth_test=False, position=anchor, visible=self.settings.anchor is not None,
        )  # fmt: skip
        self._draw_anchor()

        @self.anchor.on_update
        def _(_event: Any) -> None:
            x, y, z = (float(c) for c in self.anchor.position)
            self.set(anchor=(x, y, z), size=(0.0, 0.0, 0.0))

        @self.server.on_client_connect
        def _(client: Any) -> None:
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position, client.camera.look_at = self.camera
            client.camera.fov = self.fov

    def _build_panel(self, is_steered: bool) -> None:
        gui, settings = self.server.gui, self.settings
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        self.steered = gui.add_checkbox("anchor", settings.anchor is not None, hint=_ANCHOR)
        first = _millimetres(settings.scale)
        self.sigma = gui.add_slider(
            "sigma [mm]", min(1.0, first), max(60.0, first), 0.5, first, hint=_SIGMA
        )
        self.steering = gui.add_dropdown(
            "near anchor", get_args(Steering), initial_value=settings.steering, hint=_NEAR
        )
        self.triples = gui.add_slider("triples", 1, MOST_TRIPLES, 1, settings.triples)
        self.to_best = gui.add_checkbox("yellow is the best score", settings.to_best)
        self.instruction = gui.add_text("part or side", "", hint=_PLACE)
        self._note = gui.add_markdown("")
        if is_steered:
            gui.add_markdown("The file's own scores are steered: they are shown without an anchor.")

        @self.steered.on_update
        def _(_event: Any) -> None:
            self._move(tuple(self.anchor.position) if self.steered.value else None)

        @self.sigma.on_update
        def _(_event: Any) -> None:
            if self.sigma.value != _millimetres(self.settings.scale):  # else only shown
                self.set(sigma=1e-3 * self.sigma.value)

        @self.steering.on_update
        def _(_event: Any) -> None:
            self.set(steering=self.steering.value)

        @self.triples.on_update
        def _(_event: Any) -> None:
            self.set(triples=int(self.triples.value))

        @self.to_best.on_update
        def _(_event: Any) -> None:
            self.set(to_best=self.to_best.value)

        @self.instruction.on_update
        def _(_event: Any) -> None:
            if self.instruction.value.strip():
                self._ground(self.instruction.value)

    def _ground(self, instruction: str) -> None:
        try:
            found = PartGrounder().ground(instruction, self.target)
        except GroundingError as error:
            self._note.content = f"{error}"
            return
        self._move(tuple(found.point), tuple(found.size))

    def _show_sigma(self) -> None:
        """The slider shows a sigma that it has not set, such as that of a part."""
        value, slider = _millimetres(self.settings.scale), self.sigma
        slider.min, slider.max = min(slider.min, value), max(slider.max, value)
        slider.value = value

    def _move(
        self, anchor: tuple[float, ...] | None, size: tuple[float, ...] = (0.0, 0.0, 0.0)
    ) -> None:
        """Sets the anchor from the panel; the gizmo goes with it."""
        if anchor is not None:
            self.anchor.position = anchor
        self.anchor.visible = self.steered.value = anchor is not None
        point = None if anchor is None else tuple(float(x) for x in anchor)
        self.set(anchor=point, size=tuple(float(x) for x in size))

    def _draw(self) -> None:
        """Puts what is shown on the page, all at once."""
        scene, shown = self.server.scene, self.shown
        with self.server.atomic():
            self._mesh.glb_data = self._glb()
            for k in range(MOST_TRIPLES):
                exists = k < self.settings.triples and bool(shown.triples.valid[k])
                if exists:
                    self._draw_triple(k)
                else:
                    scene.remove_by_name(f"{_TRIPLES}/{k}")
            anchor = self.settings.anchor
            place = "" if anchor is None else "anchor ({:.1f}, {:.1f}, {:.1f}) mm, ".format(
                *(1e3 * x for x in anchor)
            )  # fmt: skip
            self._note.content = f"{place}{shown.describe()}"

    def _draw_triple(self, k: int) -> None:
        """Contacts as spheres, joined by lines, with a line outwards where each finger comes."""
        scene, name, drawn = self.server.scene, f"{_TRIPLES}/{k}", self.shown.triples
        contacts = np.stack([drawn.thumb[k], *drawn.wrap[k]])
        normals = np.stack([drawn.thumb_normal[k], *drawn.wrap_normals[k]])
        outside = contacts + _FINGER * self._size * normals
        middle = contacts[1:].mean(axis=0)
        inside = [np.stack([contacts[0], middle]), contacts[1:]]
        scene.add_line_segments(
            f"{name}/grasp", np.stack(inside), _INK, thickness=2.0, thickness_units="screen"
        )
        first = k == 0
        ends = np.repeat(np.array([THUMB, _WRAP_LINE, _WRAP_LINE] if first else [_GREY] * 3), 2, 0)
        fingers, width = np.stack([contacts, outside], axis=1), 5.0 if first else 2.0
        scene.add_line_segments(
            f"{name}/fingers",
            fingers,
            ends.reshape(3, 2, 3),
            thickness=width,
            thickness_units="screen",
        )
        for part, point, colour in zip(_PARTS, contacts, (THUMB, WRAP, WRAP), strict=True):
            radius = (0.018 if first else 0.010) * self._size
            scene.add_icosphere(f"{name}/{part}", radius, colour, position=point)

    def _glb(self) -> bytes:
        vertices, normals = np.asarray(self.heatmap.vertices), np.asarray(self.heatmap.normals)
        return coloured_glb(vertices, self.faces, normals, self.shown.colours)


def _millimetres(length: float) -> float:
    return float(f"{1e3 * length:.3g}")  # never 0
