"""From names and files to a task: what training and evaluation share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax

from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.objects.config import Weight
from mjx_grasp.objects.model import load_objects
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.sim.engines import Engine, make_physics
from mjx_grasp.sim.physics import check_control_rate
from mjx_grasp.sim.scene import Scene, SceneConfig, build_scene
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig, StartNoise
from mjx_grasp.tasks.end_to_end import EndToEndTask
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.tasks.starts import StartTable, build_starts
from mjx_grasp.tasks.task import Task

TaskConfig = ClosingTaskConfig
"""The tasks there are: the closing task, and what derives from its settings."""


@dataclass(frozen=True, eq=False)
class World:
    """A scene and the start states in it; tasks on either engine are made from it.

    It equals itself alone.
    """

    scene: Scene
    starts: StartTable

    def task(
        self,
        engine: Engine,
        worlds: int,
        config: TaskConfig,
        noise: StartNoise | None = None,
        with_privileged: bool = True,
        extra_terms: tuple[RewardTerm, ...] = (),
    ) -> Task:
        """The task on an engine.

        Args:
            engine: `mjx` (Warp) or `mujoco` (native, threads).
            worlds: Worlds that advance together.
            config: The task's numbers.
            noise: What resets draw.
            with_privileged: Whether observations hold the critic's part.
            extra_terms: Reward terms beside the task's own.
        """
        physics = make_physics(engine, self.scene, worlds, config.control_dt)
        beside = (noise, with_privileged, extra_terms)
        if isinstance(config, EndToEndConfig):
            return EndToEndTask(physics, self.starts, config, *beside)
        return ClosingTask(physics, self.starts, config, *beside)


def build_scene_of(
    names: Sequence[str],
    objects_dir: Path | None,
    robot: RobotSpec,
    config: SceneConfig,
    weight: Weight | None = None,
) -> Scene:
    """Loads the named objects and compiles the scene.

    Args:
        names: Object names or groups of the catalogue, meshes, folders of meshes.
        objects_dir: Folder of real scans; parametric stand-ins without one.
        robot: What grasps.
        config: Physics.
        weight: Of meshes; by an assumed density if None.
    """
    return build_scene(load_objects(names, objects_dir, weight=weight), robot, config)


def build_world(scene: Scene, handoffs: HandoffSet, control_dt: float) -> World:
    """Puts start states into a scene.

    Args:
        scene: It has to hold every object of the set.
        handoffs: The states.
        control_dt: Control period of the tasks to come [s].

    Raises:
        InputError: The states do not belong to the scene's objects.
    """
    return World(scene, build_starts(scene, handoffs, check_control_rate(scene, control_dt)))


def has_gpu() -> bool:
    """Whether JAX computes on a GPU here."""
    return jax.default_backend() == "gpu"
