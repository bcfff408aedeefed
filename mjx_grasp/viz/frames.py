"""Pictures of a trajectory: light and background, and files made of them.

Imports MuJoCo only inside `render`, so that the caller decides on MUJOCO_GL.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from mjx_grasp.errors import InputError, MjxGraspError
from mjx_grasp.evaluation.trajectory import Trajectory
from mjx_grasp.records.atomic import replacing
from mjx_grasp.viz import camera as view

Frame = UInt8[np.ndarray, "h w 3"]

_BACKGROUND = np.array([232, 236, 241], np.uint8)
_JUDGED = 5  # poses at which it is judged from where a film is best seen
_SUPERSAMPLING = 2  # software renderers have no smooth edges of their own


class BackendError(MjxGraspError):
    """The OpenGL backend that MUJOCO_GL names does not work on this machine."""


def render(trajectory: Trajectory, width: int, height: int, fps: float) -> list[Frame]:
    """Pictures at a steady rate, by a camera that follows the focus body and slowly turns.

    Args:
        trajectory: The motion.
        width: Of the pictures [pixels].
        height: Of the pictures [pixels].
        fps: Pictures per second of the motion.

    Raises:
        BackendError: OpenGL does not work here.
        InputError: The model was written by another version of MuJoCo.
    """
    try:
        import mujoco

        from mjx_grasp.sim.scene import OBJECT_BODY
    except Exception as error:  # a missing library surfaces as one of several types
        raise BackendError(_first_line(error)) from error
    model = load_model(trajectory)
    _set_visuals(model, width * _SUPERSAMPLING, height * _SUPERSAMPLING)
    poses = trajectory.qpos[_times(len(trajectory.qpos), trajectory.dt, fps)]
    held, distance = trajectory.focus, np.full(len(poses), view.DISTANCE_M)
    others = {model.body(i).name for i in range(model.nbody)} - {trajectory.focus}
    if OBJECT_BODY not in others:
        targets = view.look_at(model, poses, trajectory.focus, fps)
    else:
        held = OBJECT_BODY
        targets, distance = view.follow_both(model, poses, trajectory.focus, held, fps)
    turn = np.linspace(-view.TURN_DEG / 2, view.TURN_DEG / 2, len(poses))
    try:
        judged = np.linspace(0, len(poses) - 1, _JUDGED).astype(int)
        seen_at = targets[judged], distance[judged], turn[judged]
        azimuth = view.best_azimuth(model, poses[judged], held, *seen_at)
        canvas = _Canvas(model, width, height)
    except Exception as error:
        raise BackendError(_first_line(error)) from error
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.elevation = view.ELEVATION_DEG
    pictures = []
    try:
        for i, qpos in enumerate(poses):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            camera.lookat[:], camera.azimuth = targets[i], azimuth + turn[i]
            camera.distance = distance[i]
            pictures.append(canvas.picture(data, camera))
    finally:
        canvas.close()
    return pictures


class _Canvas:
    """Where pictures are drawn, larger than they are: colours and background come of one drawing.

    `mujoco.Renderer` would draw twice for that, which is most of the time where no GPU draws.
    """

    def __init__(self, model: Any, width: int, height: int):
        import mujoco

        width, height = width * _SUPERSAMPLING, height * _SUPERSAMPLING
        self._model, self._rect = model, mujoco.MjrRect(0, 0, width, height)
        self._colours = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)
        self._gl = mujoco.GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        self._option, self._nothing = mujoco.MjvOption(), mujoco.MjvPerturb()

    def picture(self, data: Any, camera: Any) -> Frame:
        """The scene as the camera sees it, before a plain background."""
        import mujoco

        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, self._option, self._nothing, camera, everything, self._scene
        )
        _add_key_light(self._scene, camera.lookat, camera.azimuth)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._colours, self._depth, self._rect, self._context)
        np.copyto(self._colours, _BACKGROUND, where=(self._depth == 0)[..., None])
        return np.flipud(np.asarray(Image.fromarray(self._colours).reduce(_SUPERSAMPLING)))

    def close(self) -> None:
        """Gives back what the graphics library holds."""
        self._context.free()
        self._gl.free()


def write(
    path: str | Path, pictures: Sequence[Frame], fps: float, max_gif_bytes: int = 2_000_000
) -> None:
    """Writes pictures as .mp4, .gif or .png, whichever the name says; a .png holds the middle one.

    Raises:
        InputError: Another suffix, or a GIF that cannot be made small enough.
    """
    suffix = Path(path).suffix
    if suffix == ".gif":
        write_gif(path, pictures, fps, max_gif_bytes)
    elif suffix == ".mp4":
        write_mp4(path, pictures, fps)
    elif suffix == ".png":
        with replacing(path) as temporary:
            Image.fromarray(pictures[len(pictures) // 2]).save(temporary)
    else:
        raise InputError("out", str(path), "a name that ends in .mp4, .gif or .png")


def write_mp4(path: str | Path, pictures: Sequence[Frame], fps: float) -> None:
    """An H.264 video that browsers play."""
    import imageio

    height, width = pictures[0].shape[:2]
    # The encoder's colour format needs even sizes.
    even: list[Any] = [picture[: height - height % 2, : width - width % 2] for picture in pictures]
    with replacing(path) as temporary:
        imageio.mimwrite(
            temporary, even, fps=fps, codec="libx264", quality=None, macro_block_size=1,
            output_params=["-crf", "20", "-movflags", "+faststart"],
        )  # fmt: skip


def write_gif(
    path: str | Path, pictures: Sequence[Frame], fps: float, max_bytes: int = 2_000_000
) -> None:
    """A looping GIF with one palette for all pictures, made smaller until it fits.

    Raises:
        InputError: Even the smallest setting is larger than `max_bytes`.
    """
    size = 0
    with replacing(path) as temporary:
        # Fewer pictures cost less to the eye than smaller ones, down to about ten a second.
        for scale, colours, least_fps in (
            (1.0, 192, 20), (1.0, 128, 12.5), (0.75, 128, 12.5), (0.6, 96, 10), (0.4, 64, 8)
        ):  # fmt: skip
            stride = max(1, round(fps / least_fps))
            _save_gif(temporary, pictures[::stride], fps / stride, scale, colours)
            size = temporary.stat().st_size
            if size <= max_bytes:
                return
        expected = f"at least {size / 1e6:.2f} MB for this motion"
        raise InputError("max_mb", max_bytes / 1e6, expected)


def _save_gif(
    path: Path, pictures: Sequence[Frame], fps: float, scale: float, colours: int
) -> None:
    height, width = pictures[0].shape[:2]
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    images = [Image.fromarray(p).resize(size, Image.Resampling.LANCZOS) for p in pictures]
    samples = images[:: max(1, len(images) // 8)]
    sheet = Image.new("RGB", (size[0], size[1] * len(samples)))
    for i, image in enumerate(samples):
        sheet.paste(image, (0, i * size[1]))
    palette = sheet.quantize(colours, method=Image.Quantize.FASTOCTREE)
    # No dithering: its noise changes from picture to picture and doubles the file.
    frames = [i.quantize(palette=palette, dither=Image.Dither.NONE) for i in images]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=round(100 / fps) * 10,
        loop=0,
        optimize=False,
    )


def load_model(trajectory: Trajectory) -> Any:
    """The model of a recorded motion.

    Raises:
        InputError: It was written by another version of MuJoCo.
    """
    import tempfile

    import mujoco

    if trajectory.mujoco_version != mujoco.__version__:
        raise InputError(
            "trajectory",
            f"a model of MuJoCo {trajectory.mujoco_version}",
            f"one of the installed MuJoCo {mujoco.__version__}: record it again",
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.mjb")
        path.write_bytes(trajectory.model)
        return mujoco.MjModel.from_binary_path(str(path))


def _times(count: int, dt: float, fps: float) -> np.ndarray:
    """Indices of the poses that are nearest to the pictures' times."""
    pictures = int((count - 1) * dt * fps) + 1
    return np.minimum(np.round(np.arange(pictures) / (fps * dt)).astype(int), count - 1)


def _set_visuals(model: Any, width: int, height: int) -> None:
    model.vis.global_.offwidth = max(width, view.JUDGED_PIXELS)
    model.vis.global_.offheight = max(height, view.JUDGED_PIXELS)
    model.vis.quality.shadowsize = 2048  # a larger map costs as much as all the rest
    model.vis.quality.offsamples = 0  # supersampling smooths edges enough, and costs less
    model.vis.map.shadowscale = 0.7
    model.vis.headlight.ambient[:] = 0.42
    model.vis.headlight.diffuse[:] = 0.38
    model.vis.headlight.specular[:] = 0.10


def _add_key_light(scene: Any, target: Float[np.ndarray, " 3"], azimuth: float) -> None:
    """A light above the camera's shoulder that casts shadows, whatever lights the model has."""
    import mujoco

    light = scene.lights[scene.nlight]
    side = np.deg2rad(azimuth + 180.0 + 55.0)
    light.type = mujoco.mjtLightType.mjLIGHT_SPOT
    light.pos[:] = target + np.array([0.8 * np.cos(side), 0.8 * np.sin(side), 1.5])
    direction = target - light.pos
    light.dir[:] = direction / np.linalg.norm(direction)
    light.attenuation[:] = (1.0, 0.0, 0.0)
    light.cutoff, light.exponent = 60.0, 1.0
    light.ambient[:] = 0.0
    light.diffuse[:] = 0.55
    light.specular[:] = 0.30
    light.headlight, light.castshadow = 0, 1
    light.bulbradius, light.range, light.texid = 0.05, 10.0, -1
    scene.nlight += 1


def _first_line(error: Exception) -> str:
    """The error's first line; some libraries' errors cannot even be printed."""
    try:
        lines = str(error).strip().splitlines()
    except Exception:
        lines = []
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
