"""Steerable and reactive three-finger dexterous grasping on JAX and MuJoCo MJX.

The names below are the public ones, by what they are about. Each is loaded when it is first used:
importing the package starts no device and prints nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__: str

_PUBLIC = {
    # Objects
    "load_catalogue": "objects.catalogue",
    "load_object": "objects.model",
    "load_objects": "objects.model",
    # Robot
    "load_robot": "robot.spec",
    "Kinematics": "robot.kinematics",
    "Measured": "robot.interface",
    "Robot": "robot.interface",
    # Heatmaps and steering
    "HeatmapConfig": "heatmap",
    "compute_heatmap": "heatmap",
    "compute_heatmaps": "heatmap",
    "heatmap_of": "heatmap",
    "heatmaps_of": "heatmap",
    "steer": "heatmap",
    "steer_many": "heatmap",
    "steer_near": "heatmap.nearness",
    "sample_triples": "heatmap.sampling",
    "save_heatmap": "heatmap.files",
    "load_heatmap": "heatmap.files",
    # Language
    "PartGrounder": "language",
    "RexOmniGrounder": "language",
    # Scene and physics
    "SceneConfig": "sim.scene",
    "build_scene": "sim.scene",
    "MjxPhysics": "sim.mjx_engine",
    "NativePhysics": "sim.native",
    "SimRobot": "sim.sim_robot",
    # Selection of three points
    "Candidates": "grasp",
    "HandPose": "grasp",
    "SelectionConfig": "grasp",
    "ThreePoints": "grasp",
    "from_heatmap": "grasp",
    "select": "grasp",
    "start_selection": "grasp",
    # Reaching
    "robot_body": "posture.body",
    "Surroundings": "posture.surroundings",
    "Planner": "reaching",
    "Reacher": "reaching",
    "reach_preset": "reaching",
    "start_library": "reaching",
    # Closing
    "Closer": "closing.closer",
    "CloserConfig": "closing.config",
    # Handoffs
    "load_handoffs": "handoff.dataset",
    "make_handoffs": "handoff.make",
    # Tasks and learning
    "ClosingTask": "tasks.closing",
    "ClosingTaskConfig": "tasks.config",
    "RewardTerm": "tasks.rewards",
    "Task": "tasks.task",
    "BraxTask": "learning.brax_env",
    "load_policy": "learning.policy",
    # Evaluation and training
    "EvaluateConfig": "evaluation.config",
    "evaluate_to_file": "evaluation.job",
    "run_trials": "evaluation.trials",
    "run_sweep": "evaluation.reach.run",
    "TrainConfig": "training.config",
    "preset_config": "training.config",
    "run_training": "training.job",
}

__all__ = ["__version__", *_PUBLIC]

if TYPE_CHECKING:  # what type checkers and editors see; a test keeps it equal to the table
    from mjx_grasp.closing.closer import Closer as Closer
    from mjx_grasp.closing.config import CloserConfig as CloserConfig
    from mjx_grasp.evaluation.config import EvaluateConfig as EvaluateConfig
    from mjx_grasp.evaluation.job import evaluate_to_file as evaluate_to_file
    from mjx_grasp.evaluation.reach.run import run_sweep as run_sweep
    from mjx_grasp.evaluation.trials import run_trials as run_trials
    from mjx_grasp.grasp import Candidates as Candidates
    from mjx_grasp.grasp import HandPose as HandPose
    from mjx_grasp.grasp import SelectionConfig as SelectionConfig
    from mjx_grasp.grasp import ThreePoints as ThreePoints
    from mjx_grasp.grasp import from_heatmap as from_heatmap
    from mjx_grasp.grasp import select as select
    from mjx_grasp.grasp import start_selection as start_selection
    from mjx_grasp.handoff.dataset import load_handoffs as load_handoffs
    from mjx_grasp.handoff.make import make_handoffs as make_handoffs
    from mjx_grasp.heatmap import HeatmapConfig as HeatmapConfig
    from mjx_grasp.heatmap import compute_heatmap as compute_heatmap
    from mjx_grasp.heatmap import compute_heatmaps as compute_heatmaps
    from mjx_grasp.heatmap import heatmap_of as heatmap_of
    from mjx_grasp.heatmap import heatmaps_of as heatmaps_of
    from mjx_grasp.heatmap import steer as steer
    from mjx_grasp.heatmap import steer_many as steer_many
    from mjx_grasp.heatmap.files import load_heatmap as load_heatmap
    from mjx_grasp.heatmap.files import save_heatmap as save_heatmap
    from mjx_grasp.heatmap.nearness import steer_near as steer_near
    from mjx_grasp.heatmap.sampling import sample_triples as sample_triples
    from mjx_grasp.language import PartGrounder as PartGrounder
    from mjx_grasp.language import RexOmniGrounder as RexOmniGrounder
    from mjx_grasp.learning.brax_env import BraxTask as BraxTask
    from mjx_grasp.learning.policy import load_policy as load_policy
    from mjx_grasp.objects.catalogue import load_catalogue as load_catalogue
    from mjx_grasp.objects.model import load_object as load_object
    from mjx_grasp.objects.model import load_objects as load_objects
    from mjx_grasp.posture.body import robot_body as robot_body
    from mjx_grasp.posture.surroundings import Surroundings as Surroundings
    from mjx_grasp.reaching import Planner as Planner
    from mjx_grasp.reaching import Reacher as Reacher
    from mjx_grasp.reaching import reach_preset as reach_preset
    from mjx_grasp.reaching import start_library as start_library
    from mjx_grasp.robot.interface import Measured as Measured
    from mjx_grasp.robot.interface import Robot as Robot
    from mjx_grasp.robot.kinematics import Kinematics as Kinematics
    from mjx_grasp.robot.spec import load_robot as load_robot
    from mjx_grasp.sim.mjx_engine import MjxPhysics as MjxPhysics
    from mjx_grasp.sim.native import NativePhysics as NativePhysics
    from mjx_grasp.sim.scene import SceneConfig as SceneConfig
    from mjx_grasp.sim.scene import build_scene as build_scene
    from mjx_grasp.sim.sim_robot import SimRobot as SimRobot
    from mjx_grasp.tasks.closing import ClosingTask as ClosingTask
    from mjx_grasp.tasks.config import ClosingTaskConfig as ClosingTaskConfig
    from mjx_grasp.tasks.rewards import RewardTerm as RewardTerm
    from mjx_grasp.tasks.task import Task as Task
    from mjx_grasp.training.config import TrainConfig as TrainConfig
    from mjx_grasp.training.config import preset_config as preset_config
    from mjx_grasp.training.job import run_training as run_training
else:

    def __getattr__(name: str) -> Any:
        if name in _PUBLIC:
            return getattr(import_module(f"mjx_grasp.{_PUBLIC[name]}"), name)
        if name == "__version__":
            return _version()
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("mjx_grasp")
    except PackageNotFoundError:  # a source tree that is not installed
        return "0.0.0"


def __dir__() -> list[str]:
    return sorted(__all__)
