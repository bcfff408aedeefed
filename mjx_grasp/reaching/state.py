"""The ways that a reach may go, what it remembers, and what a tick of it did."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.grasp.select import SelectionState
from mjx_grasp.grasp.targets import Targets
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import Goals, Memory, Report
from mjx_grasp.reaching.guide import Guide
from mjx_grasp.robot.kinematics import Motion


class ReachOutcome(IntEnum):
    """How a reach stands."""

    RUNNING = 0
    HANDOFF = 1
    """near enough for the closing policy"""
    FAILED = 2
    """out of time and re-selections"""
    NO_CANDIDATE = 3
    """out of time without an admissible candidate"""


class Plans(NamedTuple):
    """Ways to reach an object, the best first."""

    candidate: Int[Array, " p"]
    """of each"""
    reach: Float[Array, "p 3"]
    """preference of the object axes as reach direction"""
    spread: Float[Array, "p 3"]
    """direction of the wraps, object frame"""
    guide: Guide
    """each a :class:`Guide`, stacked"""


class ReachState(NamedTuple):
    """What the controller remembers."""

    selection: SelectionState
    """of the candidates"""
    memory: Memory
    """of the command"""
    plan: Int[Array, ""]
    """number of the plan that is followed; 0 also without plans"""
    guide_q: Float[Array, "2 joints"]
    """the plan's configurations as they follow the object [rad]"""
    left: Float[Array, ""]
    """share of the retreat that is left [-]"""
    timer: Float[Array, ""]
    """the fine-adjustment timer [s]"""
    near: Float[Array, ""]
    """time for which every tip has been within the gate's `near_tips` while nothing moves [s]"""
    clock: Float[Array, ""]
    """since the start [s]"""
    tries: Int[Array, ""]
    """re-selections made"""
    best: Float[Array, " 2"]
    """least time to go so far, of joints to the guide and of tips to targets [s]"""
    since: Float[Array, ""]
    """time since it was improved [s]"""
    stale: Bool[Array, ""]
    """whether the plans no longer fit, and new ones are due until they are there"""
    planned_p: Float[Array, " 3"]
    """object origin in world that they were made for [m]"""
    planned_R: Float[Array, "3 3"]
    """object rotation that they were made for"""
    p_wo: Float[Array, " 3"]
    """object origin in world at the last tick [m]"""
    R_wo: Float[Array, "3 3"]
    """object rotation at the last tick"""
    obstacles: Float[Array, "k 4"]
    """at the last tick; NaN before the first [m]"""
    outcome: Int[Array, ""]
    """a :class:`ReachOutcome`"""
    infeasible: Int[Array, ""]
    """ticks whose programme had no solution"""


class ReachTick(NamedTuple):
    """What one tick did."""

    velocity: Float[Array, " joints"]
    """the command [rad/s]"""
    targets: Targets
    """the three-point interface"""
    goals: Float[Array, "3 3"]
    """standoff targets, world [m]"""
    tips: Float[Array, "3 3"]
    """tip frames, world [m]"""
    ready: Bool[Array, ""]
    """whether the hand is near enough for the closing policy"""
    report: Report
    """errors, distances, feasibility"""


class Aim(NamedTuple):
    """What a tick goes for, and what moves around it."""

    motion: Motion
    """the robot"""
    around: Surroundings
    """object and obstacles"""
    moves: Bool[Array, ""]
    """whether the object does"""
    targets: Targets
    """the three-point interface"""
    selection: SelectionState
    """after the tick"""
    goals: Goals
    """where tips, pads and the whole hand are to be"""
    guide_q: Float[Array, "2 joints"]
    """the plan's configurations for the object's present pose [rad]"""
    left: Float[Array, ""]
    """share of the retreat that is left after the tick [-]"""
