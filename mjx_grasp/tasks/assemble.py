"""From names and files to an environment: what training and evaluation share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax

from mjx_grasp.closing.config import ClosingConfig, StartNoise
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import load_objects
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.mjx_engine import MjxPhysics
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import Physics, check_control_rate
from mjx_grasp.sim.scene import Scene, SceneConfig, build_scene
from mjx_grasp.tasks.closing import ClosingEnv
from mjx_grasp.tasks.starts import StartTable, build_starts

Engine = Literal["mjx", "mujoco"]


@dataclass(frozen=True)
class World:
    """A scene and the start states in it; environments on either engine are made from it."""

    scene: Scene
    starts: StartTable

    def env(
        self,
        engine: Engine,
        worlds: int,
        task: ClosingConfig,
        noise: StartNoise | None = None,
        with_privileged: bool = True,
    ) -> ClosingEnv:
        """The closing task on an engine.

        Args:
            engine: `mjx` (Warp) or `mujoco` (native, threads).
            worlds: Worlds that advance together.
            task: The task's numbers.
            noise: What resets draw.
            with_privileged: Whether observations hold the critic's part.
        """
        physics: Physics = (
            MjxPhysics(self.scene, worlds, task.control_dt)
            if engine == "mjx"
            else NativePhysics(self.scene, task.control_dt)
        )
        return ClosingEnv(physics, self.starts, task, noise, with_privileged)


def build_scene_of(names: Sequence[str], objects_dir: Path | None, config: SceneConfig) -> Scene:
    """Loads the robot and the named objects and compiles the scene.

    Args:
        names: Object names or groups of the catalogue.
        objects_dir: Folder of real scans; parametric stand-ins without one.
        config: Physics.
    """
    return build_scene(load_objects(resolve(names), objects_dir), load_robot(), config)


def build_world(scene: Scene, handoffs: HandoffSet, task: ClosingConfig) -> World:
    """Puts start states into a scene.

    Raises:
        InputError: The states do not belong to the scene's objects.
    """
    substeps = check_control_rate(scene, task.control_dt)
    return World(scene, build_starts(scene, handoffs, substeps))


def has_gpu() -> bool:
    """Whether JAX computes on a GPU here."""
    return jax.default_backend() == "gpu"
