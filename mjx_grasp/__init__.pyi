"""The public names, by what they are about, each with the module that it is loaded from."""

__version__: str
__all__: list[str]

# Objects
from mjx_grasp.objects.catalogue import load_catalogue as load_catalogue
from mjx_grasp.objects.model import load_object as load_object
from mjx_grasp.objects.model import load_objects as load_objects

# Robot
from mjx_grasp.robot.spec import load_robot as load_robot
from mjx_grasp.robot.kinematics import Kinematics as Kinematics
from mjx_grasp.robot.interface import Measured as Measured
from mjx_grasp.robot.interface import Robot as Robot

# Heatmaps and steering
from mjx_grasp.heatmap.config import HeatmapConfig as HeatmapConfig
from mjx_grasp.heatmap.compute import compute_heatmap as compute_heatmap
from mjx_grasp.heatmap.compute import compute_heatmaps as compute_heatmaps
from mjx_grasp.heatmap.compute import heatmap_of as heatmap_of
from mjx_grasp.heatmap.compute import heatmaps_of as heatmaps_of
from mjx_grasp.heatmap.steering import steer as steer
from mjx_grasp.heatmap.steering import steer_contacts as steer_contacts
from mjx_grasp.heatmap.steering import steer_many as steer_many
from mjx_grasp.heatmap.steering import steer_near as steer_near
from mjx_grasp.heatmap.steering import steer_to as steer_to
from mjx_grasp.heatmap.sampling import sample_triples as sample_triples
from mjx_grasp.heatmap.files import save_heatmap as save_heatmap
from mjx_grasp.heatmap.files import load_heatmap as load_heatmap

# Language
from mjx_grasp.language.parts import PartGrounder as PartGrounder
from mjx_grasp.language.rex_omni import RexOmniGrounder as RexOmniGrounder

# Scene and physics
from mjx_grasp.sim.scene import SceneConfig as SceneConfig
from mjx_grasp.sim.scene import build_scene as build_scene
from mjx_grasp.sim.mjx_engine import MjxPhysics as MjxPhysics
from mjx_grasp.sim.native import NativePhysics as NativePhysics
from mjx_grasp.sim.sim_robot import SimRobot as SimRobot

# Selection of three points
from mjx_grasp.grasp.candidates import Candidates as Candidates
from mjx_grasp.grasp.select import HandPose as HandPose
from mjx_grasp.grasp.config import SelectionConfig as SelectionConfig
from mjx_grasp.grasp.points import ThreePoints as ThreePoints
from mjx_grasp.grasp.candidates import from_heatmap as from_heatmap
from mjx_grasp.grasp.select import select as select
from mjx_grasp.grasp.select import start_selection as start_selection

# Reaching
from mjx_grasp.posture.body import robot_body as robot_body
from mjx_grasp.posture.surroundings import Surroundings as Surroundings
from mjx_grasp.reaching.planning import Planner as Planner
from mjx_grasp.reaching.controller import Reacher as Reacher
from mjx_grasp.reaching.presets import reach_preset as reach_preset
from mjx_grasp.reaching.planning import start_library as start_library

# Closing
from mjx_grasp.closing.closer import Closer as Closer
from mjx_grasp.closing.config import CloserConfig as CloserConfig

# Whole grasps
from mjx_grasp.pipeline.assemble import grasper_of as grasper_of
from mjx_grasp.pipeline.assemble import whole_grasps as whole_grasps
from mjx_grasp.pipeline.config import GrasperConfig as GrasperConfig
from mjx_grasp.pipeline.flat import FlatTick as FlatTick
from mjx_grasp.pipeline.grasper import Grasper as Grasper
from mjx_grasp.pipeline.known import known_object as known_object
from mjx_grasp.pipeline.state import Known as Known
from mjx_grasp.pipeline.state import Seen as Seen
from mjx_grasp.pipeline.state import smoothed as smoothed
from mjx_grasp.closing.learned import LearnedPolicy as LearnedPolicy

# Handoffs
from mjx_grasp.handoff.dataset import load_handoffs as load_handoffs
from mjx_grasp.handoff.make import make_handoffs as make_handoffs

# Tasks and learning
from mjx_grasp.tasks.closing import ClosingTask as ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig as ClosingTaskConfig
from mjx_grasp.tasks.end_to_end import EndToEndTask as EndToEndTask
from mjx_grasp.tasks.config import EndToEndConfig as EndToEndConfig
from mjx_grasp.tasks.rewards import RewardTerm as RewardTerm
from mjx_grasp.tasks.task import Task as Task
from mjx_grasp.learning.brax_env import BraxTask as BraxTask
from mjx_grasp.learning.policy import load_policy as load_policy
from mjx_grasp.learning.numpy_policy import NumpyPolicy as NumpyPolicy

# Evaluation and training
from mjx_grasp.evaluation.grasps.rollout import grasp_all as grasp_all
from mjx_grasp.evaluation.config import EvaluateConfig as EvaluateConfig
from mjx_grasp.evaluation.job import evaluate_to_file as evaluate_to_file
from mjx_grasp.evaluation.trials import run_trials as run_trials
from mjx_grasp.evaluation.reach.run import run_sweep as run_sweep
from mjx_grasp.training.config import TrainConfig as TrainConfig
from mjx_grasp.training.config import preset_config as preset_config
from mjx_grasp.training.job import run_training as run_training
