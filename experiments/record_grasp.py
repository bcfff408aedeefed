"""Records a grasp of the policy in native MuJoCo and renders it: the README's picture.

python experiments/record_grasp.py --object tomato_soup_can --objects-dir DIR --out docs/grasp.gif
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.trajectory import save_trajectory
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, states_of
from mjx_grasp.learning.controller import load_controller
from mjx_grasp.records.settings import CommandSettings, Seed
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, build_scene_of, build_world
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.training.after import best_grasp
from mjx_grasp.viz.rendering import VideoConfig, render_in_subprocess


@dataclass(frozen=True)
class RecordConfig(CommandSettings):
    """What to record."""

    out: Path = Path("docs/grasp.gif")
    """.gif (at most 2 MB), .mp4 or .png"""
    object: str = "tomato_soup_can"
    objects_dir: Path | None = None
    """folder of real scans; the parametric stand-in without one"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    seed: Seed = 0


def main(config: RecordConfig) -> None:
    """Records and renders."""
    robot = load_robot()
    policy = load_controller(config.policy or asset_path("policy.npz"), robot)
    scene = build_scene_of([config.object], config.objects_dir, robot, SceneConfig())
    stored = load_handoffs(shipped_handoffs(config.objects_dir), robot=robot)
    world = build_world(
        scene, states_of(stored, [config.object], "evaluation"), TaskConfig().control_dt
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grasp.npz"
        save_trajectory(path, best_grasp(world, config.object, policy, StartNoise(), config.seed))
        render_in_subprocess(VideoConfig(path, out=config.out, width=480, height=360))
    print(f"wrote {config.out}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(RecordConfig, description=__doc__)))
