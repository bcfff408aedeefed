"""A recorded trajectory as a video, a GIF or a picture, on machines without a display too.

MuJoCo chooses its renderer when it is first imported. Rendering therefore happens in a process of
its own, without a display: through EGL, or else through OSMesa.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjx_grasp.errors import MjxGraspError
from mjx_grasp.evaluation.trajectory import load_trajectory
from mjx_grasp.records.atomic import check_writable
from mjx_grasp.records.settings import CommandSettings, Positive, Range, Suffix

BACKENDS = ("egl", "osmesa")
_RENDERING_FAILED = 3  # exit status of the child when it is the renderer that fails
_TIMEOUT_S = 600.0  # that one backend may take
Pixels = Annotated[int, Range(16, 4096)]
INSTALL = (
    "on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri (EGL), "
    "or apt-get install libosmesa6 (software only)"
)


class RenderError(MjxGraspError):
    """No picture could be rendered; the text says what is missing and how to get it."""


@dataclass(frozen=True)
class VideoConfig(CommandSettings):
    """Renders a recorded trajectory, without a display, to a video, a GIF or one picture."""

    trajectory: Annotated[Path, tyro.conf.Positional]
    """the trajectory (.npz), as a training or a demo leaves it in its folder"""
    out: Annotated[Path, Suffix((".mp4", ".gif", ".png"))] = Path("grasp.mp4")
    """where to write: .mp4, .gif (looping, within --max-mb) or .png (the middle of the motion)"""
    width: Pixels = 640
    """width of the picture [pixels]"""
    height: Pixels = 480
    """height of the picture [pixels]"""
    fps: Annotated[int, Range(1, 120)] = 25
    """pictures per second of the motion [1/s]"""
    speed: Positive = 1.0
    """seconds of motion per second of video [-]"""
    max_mb: Positive = 2.0
    """largest size of a GIF; size and frame rate are lowered until it fits [MB]"""


def render_in_subprocess(config: VideoConfig) -> None:
    """Renders with the first backend that works, each tried in a process of its own.

    Args:
        config: What to render and where to.

    Raises:
        FileError: The trajectory cannot be read.
        RenderError: No backend works on this machine, or the rendering failed.
    """
    load_trajectory(config.trajectory)
    failures = []
    for backend in BACKENDS:
        reason = _try_backend(config, backend)
        if reason is None:
            return
        failures.append(f"{backend}: {reason}")
    raise RenderError(
        f"{config.trajectory}: no renderer works here ({'; '.join(failures)}). "
        f"To get one, {INSTALL}"
    )


def _try_backend(config: VideoConfig, backend: str) -> str | None:
    """None on success, the reason where the backend does not work here."""
    command = [sys.executable, "-m", "mjx_grasp.viz.video", str(config.trajectory)]
    for name in ("out", "width", "height", "fps", "speed", "max_mb"):
        command += [f"--{name.replace('_', '-')}", str(getattr(config, name))]
    environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        raise RenderError(f"{config.trajectory}: rendering took over {_TIMEOUT_S:.0f} s") from None
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
    # A crash of the graphics library ends the process by a signal: also the backend's doing.
    if done.returncode == _RENDERING_FAILED or done.returncode < 0:
        return lines[-1]
    raise RenderError(f"{config.trajectory}: rendering failed: {lines[-1]}")


def make_video(config: VideoConfig) -> None:
    """Renders here if MUJOCO_GL names a backend, else in a process where it does.

    Where the backend does not work, the process ends: the one that has started it tries another.

    Raises:
        FileError: The trajectory cannot be read.
        InputError: The video cannot be written.
        RenderError: No backend works on this machine, or the rendering failed.
    """
    check_writable("--out", config.out)
    if os.environ.get("MUJOCO_GL", "").lower() not in BACKENDS:
        render_in_subprocess(config)
        return
    from mjx_grasp.viz import frames

    trajectory = load_trajectory(config.trajectory)
    try:
        rate = config.fps / config.speed
        pictures = frames.render(trajectory, config.width, config.height, rate)
    except frames.BackendError as error:
        print(error, file=sys.stderr)
        sys.exit(_RENDERING_FAILED)
    frames.write(config.out, pictures, config.fps, round(config.max_mb * 1e6))
