"""Whether MuJoCo can render here."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

from mjx_grasp.viz.frames import BackendError
from mjx_grasp.viz.rendering import BACKENDS, INSTALL, RenderError


def check_backend() -> None:
    """Finds out whether MuJoCo renders in this process, with what MUJOCO_GL names, by doing it.

    Raises:
        BackendError: It does not.
    """
    try:
        import mujoco

        with warnings.catch_warnings():  # GLFW tells twice what fails, and then fails
            warnings.simplefilter("ignore")
            with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16) as renderer:
                renderer.render()
    except Exception as error:
        raise BackendError(f"{type(error).__name__}: {error}") from error


def check_films() -> None:
    """Finds out whether a process beside this one, as those that make films, can render.

    Raises:
        RenderError: No backend works here.
    """
    for backend in BACKENDS:
        env = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        if not subprocess.run([sys.executable, __file__], env=env, capture_output=True).returncode:
            return
    raise RenderError(f"no renderer works here ({', '.join(BACKENDS)}). To get one, {INSTALL}")


if __name__ == "__main__":
    check_backend()
