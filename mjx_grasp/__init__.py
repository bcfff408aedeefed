"""Steerable and reactive three-finger dexterous grasping on JAX and MuJoCo MJX.

The public names below are loaded when they are first used: importing the package starts no device
and prints nothing.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

try:
    __version__ = version("mjx_grasp")
except PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0.0.0"

_PUBLIC = {
    "load_catalogue": "mjx_grasp.objects.catalogue",
    "load_object": "mjx_grasp.objects.model",
    "load_objects": "mjx_grasp.objects.model",
    "load_robot": "mjx_grasp.robot.spec",
    "Kinematics": "mjx_grasp.robot.kinematics",
    "HeatmapConfig": "mjx_grasp.heatmap",
    "compute_heatmap": "mjx_grasp.heatmap",
    "compute_heatmaps": "mjx_grasp.heatmap",
    "heatmap_of": "mjx_grasp.heatmap",
    "heatmaps_of": "mjx_grasp.heatmap",
    "steer": "mjx_grasp.heatmap",
    "steer_many": "mjx_grasp.heatmap",
    "steer_near": "mjx_grasp.heatmap.nearness",
    "sample_triples": "mjx_grasp.heatmap.sampling",
    "save_heatmap": "mjx_grasp.heatmap.files",
    "load_heatmap": "mjx_grasp.heatmap.files",
    "PartGrounder": "mjx_grasp.language",
    "RexOmniGrounder": "mjx_grasp.language",
    "load_handoffs": "mjx_grasp.handoff.dataset",
    "build_scene": "mjx_grasp.sim.scene",
    "MjxPhysics": "mjx_grasp.sim.mjx_engine",
    "NativePhysics": "mjx_grasp.sim.native",
    "ClosingTaskConfig": "mjx_grasp.tasks.config",
    "ClosingTask": "mjx_grasp.tasks.closing",
    "load_policy": "mjx_grasp.learning.policy",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
