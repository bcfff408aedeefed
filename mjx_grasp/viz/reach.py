"""The sweep as a plot, and its failures as rendered pictures.

Imports MuJoCo's renderer only when it is used, so that the caller decides on MUJOCO_GL.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.evaluation.reach.results import FAILURES, PAPER_RATE
from mjx_grasp.evaluation.reach.sweep import BUDGETS, ReachRecord

_GREY = "#5b6470"
_SIZE = 320


def rate_plot(result: dict[str, Any], label: str) -> bytes:
    """Rates over the budget, one colour per tolerance, the paper's dashed; PNG."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    for k, (tolerance, ours) in enumerate(result["rate_percent"].items()):
        colour = f"C{k}"
        # Thinner one over the other: where they agree each is seen.
        width = 9.0 - 1.8 * k
        axes.plot(
            BUDGETS, list(ours.values()), color=colour, linewidth=width, label=f"{tolerance} mm"
        )
        axes.plot(BUDGETS, PAPER_RATE[tolerance], "--", color=colour, alpha=0.6)
    axes.set_ylim(-2, 102)
    axes.set_xlabel("fine-adjustment time [s]", color=_GREY)
    axes.set_ylabel("reaches converged [%]", color=_GREY)
    axes.set_title(f"{label} (solid) and published (dashed)", loc="left", fontsize=10, color=_GREY)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def render_reach(
    robot_spec: Any,
    q: Float[np.ndarray, " joints"],
    poses: CylinderPoses,
    index: int,
) -> UInt8[np.ndarray, "h w 3"]:
    """The robot at a configuration beside the cylinder of a pose.

    Args:
        robot_spec: A :class:`RobotSpec`.
        q: Configuration, [rad].
        poses: The cylinders.
        index: Which one.
    """
    import mujoco

    from mjx_grasp.robot.mjcf import robot_mjspec

    spec = robot_mjspec(robot_spec)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.35, 0.0, -0.02],
        size=[0.65, 0.70, 0.02],
        rgba=[0.78, 0.74, 0.68, 1.0],
    )
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, poses.R_wo[index].astype(np.float64).ravel())
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=poses.p_wo[index].astype(float).tolist(),
        quat=quat.tolist(),
        size=[float(poses.radius[index]), float(poses.half_length[index]), 0.0],
        rgba=[0.85, 0.37, 0.25, 1.0],
    )
    spec.worldbody.add_light(pos=[0.2, -0.6, 1.5], dir=[0.2, 0.4, -1.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation, camera.azimuth = 0.75, -25.0, 205.0
    camera.lookat[:] = poses.p_wo[index]
    with mujoco.Renderer(model, _SIZE, _SIZE) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render().copy()


def failure_gallery(
    path: Path,
    robot_spec: Any,
    poses: CylinderPoses,
    record: ReachRecord,
    classes: np.ndarray,
    per_class: int = 4,
) -> None:
    """A sheet of pictures: a row per class of failure, and one of reaches that converged.

    Each shows the configuration in which the reach came nearest, under its pose number and error.
    """
    from PIL import Image, ImageDraw

    from mjx_grasp.records.atomic import replacing

    kinds = [("converged", -1), *((name, k) for k, name in enumerate(FAILURES))]
    shown = [(name, np.flatnonzero(classes == k)[:per_class]) for name, k in kinds]
    rows = [(name, picked) for name, picked in shown if len(picked)]
    caption = 18
    sheet = Image.new("RGB", (per_class * _SIZE, len(rows) * (_SIZE + caption)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (name, picked) in enumerate(rows):
        for j, index in enumerate(picked):
            picture = render_reach(robot_spec, np.asarray(record.best_q[index]), poses, int(index))
            corner = (j * _SIZE, i * (_SIZE + caption))
            sheet.paste(Image.fromarray(picture), (corner[0], corner[1] + caption))
            error = 1e3 * float(record.best_error[index])
            draw.text(
                (corner[0] + 4, corner[1] + 3), f"{name}: pose {index}, {error:.0f} mm", "black"
            )
    with replacing(path) as temporary:
        sheet.save(temporary)
