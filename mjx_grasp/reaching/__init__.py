"""Reactive reaching: velocity fields, a joint-space QP, and the controller around it (§3)."""

from mjx_grasp.posture.body import Body, robot_body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.config import ReachConfig
from mjx_grasp.reaching.controller import Outcome, Plans, Reacher, ReachState, Tick
from mjx_grasp.reaching.planning import PlanConfig, plan_again, plan_reach, start_library
from mjx_grasp.reaching.presets import Preset, preset

__all__ = [
    "Outcome",
    "PlanConfig",
    "Plans",
    "Preset",
    "Body",
    "ReachConfig",
    "ReachState",
    "Reacher",
    "Surroundings",
    "Tick",
    "plan_again",
    "plan_reach",
    "preset",
    "robot_body",
    "start_library",
]
