"""Handoff datasets: sampling, inverse kinematics, collision filter, file (method §4)."""

from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs, merge

__all__ = ["HandoffConfig", "HandoffSet", "load_handoffs", "merge"]
