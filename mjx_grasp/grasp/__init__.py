"""Online three-point selection: which candidate, and its three targets (method §2)."""

from mjx_grasp.grasp.candidates import Candidates, cylinder_candidates, from_heatmap
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.select import (
    NONE,
    Hand,
    SelectionState,
    Targets,
    select,
    start_selection,
)

__all__ = [
    "NONE",
    "Candidates",
    "Hand",
    "SelectionConfig",
    "SelectionState",
    "Targets",
    "cylinder_candidates",
    "from_heatmap",
    "select",
    "start_selection",
]
