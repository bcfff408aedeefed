"""The engines by their names."""

from __future__ import annotations

from typing import Literal

from mjx_grasp.sim.mjx_engine import MjxPhysics
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import Physics
from mjx_grasp.sim.scene import Scene

Engine = Literal["mjx", "mujoco"]
"""MuJoCo Warp, as MJX ships it, or native MuJoCo in threads"""
WORLDS: dict[Engine, int] = {"mujoco": 256, "mjx": 4096}
"""Worlds of a batch, as far as there are so many trials."""


def make_physics(engine: Engine, scene: Scene, worlds: int, control_dt: float) -> Physics:
    """Worlds of a scene on an engine.

    Args:
        engine: Which one.
        scene: The scene whose objects the worlds hold.
        worlds: How many advance together.
        control_dt: Control period [s].
    """
    if engine == "mjx":
        return MjxPhysics(scene, worlds, control_dt)
    return NativePhysics(scene, control_dt)
