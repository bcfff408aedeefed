"""`python -m mjx_grasp.viz.video`: a recorded trajectory as a video, a GIF or a picture.

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

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError, MjxGraspError
from mjx_grasp.evaluation.trajectory import load_trajectory
from mjx_grasp.records.atomic import check_writable

BACKENDS = ("egl", "osmesa")
_FORMATS = (".mp4", ".gif", ".png")
_RENDERING_FAILED = 3  # exit status of the child when it is the renderer that fails
INSTALL = (
    "on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri (EGL), "
    "or apt-get install libosmesa6 (software only)"
)


class RenderError(MjxGraspError):
    """No picture could be rendered; the text says what is missing and how to get it."""


@dataclass(frozen=True)
class VideoConfig:
    """Renders a recorded trajectory, without a display, to a video, a GIF or one picture."""

    trajectory: Annotated[Path, tyro.conf.Positional]
    """The trajectory (.npz), as a training leaves it in its folder."""
    out: Path = Path("grasp.mp4")
    """Where to write: .mp4, .gif (looping, within --max-mb) or .png (the middle of the motion)."""
    width: int = 640
    """Width of the picture [pixels]."""
    height: int = 480
    """Height of the picture [pixels]."""
    fps: int = 25
    """Pictures per second of the motion."""
    speed: float = 1.0
    """Seconds of motion per second of video."""
    max_mb: float = 2.0
    """Largest size of a GIF [MB]; size and frame rate are lowered until it fits."""

    def __post_init__(self):
        if self.out.suffix not in _FORMATS:
            raise InputError("out", str(self.out), f"a name that ends in {', '.join(_FORMATS)}")
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 4096:
                raise InputError(name, getattr(self, name), "16 to 4096 pixels")
        if not 1 <= self.fps <= 120:
            raise InputError("fps", self.fps, "1 to 120 pictures per second")
        if self.speed <= 0 or self.max_mb <= 0:
            raise InputError("speed and max_mb", (self.speed, self.max_mb), "positive numbers")


def render_in_subprocess(config: VideoConfig, timeout_s: float = 600.0) -> None:
    """Renders with the first backend that works, each tried in a process of its own.

    Args:
        config: What to render and where to.
        timeout_s: Longest time that one backend may take [s].

    Raises:
        FileError: The trajectory cannot be read.
        RenderError: No backend works on this machine, or the rendering failed.
    """
    load_trajectory(config.trajectory)
    failures = []
    for backend in BACKENDS:
        reason = _try_backend(config, backend, timeout_s)
        if reason is None:
            return
        failures.append(f"{backend}: {reason}")
    raise RenderError(
        f"{config.trajectory}: no renderer works here ({'; '.join(failures)}). "
        f"To get one, {INSTALL}"
    )


def _try_backend(config: VideoConfig, backend: str, timeout_s: float) -> str | None:
    """None on success, the reason where the backend does not work here."""
    command = [sys.executable, "-m", "mjx_grasp.viz.video", str(config.trajectory)]
    for name in ("out", "width", "height", "fps", "speed", "max_mb"):
        command += [f"--{name.replace('_', '-')}", str(getattr(config, name))]
    environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        raise RenderError(f"{config.trajectory}: rendering took over {timeout_s:.0f} s") from None
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
    # A crash of the graphics library ends the process by a signal: also the backend's doing.
    if done.returncode == _RENDERING_FAILED or done.returncode < 0:
        return lines[-1]
    raise RenderError(f"{config.trajectory}: rendering failed: {lines[-1]}")


def main(config: VideoConfig) -> None:
    """Renders here if MUJOCO_GL names a backend, else in a process where it does."""
    check_writable("--out", config.out)
    if os.environ.get("MUJOCO_GL", "").lower() not in BACKENDS:
        render_in_subprocess(config)
        print(f"written: {config.out}")
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


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(VideoConfig, description=__doc__)))
