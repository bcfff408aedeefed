"""Whether MuJoCo can render here."""

from __future__ import annotations

import warnings

from mjx_grasp.viz.frames import BackendError


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
