"""Online three-point selection: which candidate, and its three targets (method §2)."""

from mjx_grasp.grasp.candidates import Candidates, cylinder_candidates, from_heatmap
from mjx_grasp.grasp.config import SelectionConfig, TargetConfig
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.grasp.select import HandPose, SelectionState, select, start_selection
from mjx_grasp.grasp.targets import NONE, Targets, admissible, standoffs, target_options

__all__ = [
    "NONE",
    "Candidates",
    "HandPose",
    "SelectionConfig",
    "SelectionState",
    "TargetConfig",
    "Targets",
    "ThreePoints",
    "admissible",
    "cylinder_candidates",
    "from_heatmap",
    "select",
    "standoffs",
    "start_selection",
    "target_options",
]
