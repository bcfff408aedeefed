"""Pictures of reaches that failed, and of some that did not, class by class.

  MUJOCO_GL=egl python experiments/reach_failures.py

sweeps as `python -m mjx_grasp.sweep_reach` does and draws `docs/reach_failures.png`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from renderer import check_backend
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.evaluation.reach.record import ReachRecord
from mjx_grasp.evaluation.reach.results import FAILURES
from mjx_grasp.evaluation.reach.run import run_sweep
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.records.atomic import check_writable, replacing
from mjx_grasp.records.settings import CommandSettings, Count, Seed, Suffix
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot

_SIZE = 320


@dataclass(frozen=True)
class FailuresConfig(CommandSettings):
    """What to sweep, and where to draw it."""

    poses: Count = 2752
    """randomised cylinder poses [-]"""
    seed: Seed = 20
    """of the poses"""
    preset: str = "default"
    """of the controller, as for the sweep"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    out: Annotated[Path, Suffix((".png",))] = Path("docs/reach_failures.png")


def main(config: FailuresConfig) -> None:
    """The command."""
    check_writable("--out", config.out)
    check_backend()  # pictures come last, after minutes
    robot, settings = load_robot(config.robot), reach_preset(config.preset)
    run = run_sweep(robot, settings, config.poses, config.seed, console=Console())
    failure_gallery(config.out, robot, run.poses, run.record, run.classes)
    print(f"written: {config.out}")


def render_reach(
    robot_spec: RobotSpec,
    q: Float[np.ndarray, " joints"],
    poses: CylinderPoses,
    index: int,
) -> UInt8[np.ndarray, "h w 3"]:
    """The robot at a configuration beside the cylinder of a pose.

    Args:
        robot_spec: The robot.
        q: Configuration, [rad].
        poses: The cylinders.
        index: Which one.
    """
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
    robot_spec: RobotSpec,
    poses: CylinderPoses,
    record: ReachRecord,
    classes: np.ndarray,
    per_class: int = 4,
) -> None:
    """A sheet of pictures: a row per class of failure, and one of reaches that converged.

    Each shows the configuration in which the reach came nearest, under its pose number and error.
    """
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


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FailuresConfig, description=__doc__)))
