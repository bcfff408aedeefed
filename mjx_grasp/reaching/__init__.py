"""Reactive reaching: velocity fields, a joint-space QP, and the controller around it (§3)."""

from mjx_grasp.posture.body import Body, robot_body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.controller import Plans, Reacher, ReachOutcome, ReachState, ReachTick
from mjx_grasp.reaching.planning import PlanConfig, Planner, plan_again, start_library
from mjx_grasp.reaching.presets import ReachPreset, reach_preset

__all__ = [
    "ReachOutcome",
    "PlanConfig",
    "Planner",
    "Plans",
    "ReachPreset",
    "Body",
    "ReachConfig",
    "ReachState",
    "Reacher",
    "Surroundings",
    "ReachTick",
    "plan_again",
    "reach_preset",
    "robot_body",
    "start_library",
]
