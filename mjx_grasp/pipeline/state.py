"""What a grasp is told, what it remembers, and what a tick of it did."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.closer import CloserState
from mjx_grasp.geometry.signed_distance import Shape
from mjx_grasp.geometry.vectors import turned, turned_back
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.pipeline.pose_filter import PoseEstimate
from mjx_grasp.reaching.state import Plans, ReachState


class Known(NamedTuple):
    """What is known of the object before a grasp; object frame."""

    shape: Shape
    """what to keep away from while reaching"""
    candidates: Candidates
    """where it may be grasped"""
    weight: Float[Array, ""]
    """as far as it is known, 0 where it is not [N]"""
    com: Float[Array, " 3"]
    """centre of mass [m]"""


class Ways(NamedTuple):
    """Ways to grasp the object, the best first."""

    plans: Plans
    """to reach it"""
    force: Float[Array, " p"]
    """F with which the grip of each begins [N]"""
    p_wo: Float[Array, " 3"]
    """object origin in world that they were made for [m]"""
    R_wo: Float[Array, "3 3"]
    """object rotation that they were made for"""
    failures: Int[Array, ""]
    """how many tries had failed then"""


class Seen(NamedTuple):
    """What is perceived beside the robot at a tick; world frame."""

    p_wo: Float[Array, " 3"]
    """tracked object origin [m]"""
    R_wo: Float[Array, "3 3"]
    """tracked object rotation"""
    touching: Bool[Array, " f"]
    """contact flags from outside, all false if there are none"""
    obstacles: Float[Array, "k 4"]
    """spheres to avoid while reaching: centre and radius [m]"""


class Tried(NamedTuple):
    """What new plans have to know of the tries before."""

    failures: Int[Array, "*w"]
    """how many have failed, a reach in vain counting twice"""
    avoid: Float[Array, "*w 3"]
    """thumb contact of the last that failed after closing, object frame; +inf before that [m]"""

    @classmethod
    def nothing(cls, *worlds: int) -> Tried:
        """Before the first try, in one world or several."""
        return cls(jnp.zeros(worlds, jnp.int32), jnp.full((*worlds, 3), jnp.inf, jnp.float32))


class ClosingMemory(NamedTuple):
    """What is remembered from the handoff on."""

    fresh: Bool[Array, ""]
    """whether the closer has yet to start"""
    contacts: ThreePoints
    """in the object frame"""
    closer: CloserState
    action: Float[Array, " a"]
    """the policy's last"""
    stack: Float[Array, "s d"]
    """of its observations"""
    in_palm: Float[Array, " 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""


class Handoff(NamedTuple):
    """How well the hand was placed when closing began; NaN before."""

    error: Float[Array, " 3"]
    """tip frames to their standoff targets [m]"""
    midpoint: Float[Array, ""]
    """of midpoints [m]"""


class GraspState(NamedTuple):
    """What the controller remembers."""

    phase: Int[Array, ""]
    """a :class:`~mjx_grasp.pipeline.phases.Phase`"""
    failure: Int[Array, ""]
    """a :class:`~mjx_grasp.pipeline.phases.Failure`"""
    clock: Float[Array, ""]
    """since the start [s]"""
    entered: Float[Array, " phases"]
    """clock at which each phase was last entered, NaN if it never was [s]"""
    returns: Int[Array, ""]
    """times that the object was reached for again after a handoff"""
    retries: Int[Array, ""]
    """times that a grasp or reach that failed was begun again; after a grasp it is a return too"""
    vain: Int[Array, ""]
    """of these, after a reach in vain"""
    avoid: Float[Array, " 3"]
    """thumb contact of that grasp, object frame, +inf before the first [m]"""
    pose: PoseEstimate
    """of the object"""
    reach: ReachState
    ways: Ways | None
    """ways to grasp the object; none without a planner"""
    reference: Float[Array, " n"]
    """integrated joint positions [rad]"""
    target: Float[Array, " n"]
    """joint position targets sent last [rad]"""
    closing: ClosingMemory
    handoff: Handoff

    @property
    def tried(self) -> Tried:
        """What new plans have to know."""
        return Tried(self.retries + self.vain, self.avoid)


class GraspTick(NamedTuple):
    """What one tick did."""

    target: Float[Array, " n"]
    """joint position targets, robot order [rad]"""
    plans_due: Bool[Array, ""]
    """whether new plans are to be looked for"""
    contacts: ThreePoints
    """the three points that the hand goes for, world frame"""
    tip_error: Float[Array, " 3"]
    """while reaching, tip frames to their standoff targets; then pads to their contacts [m]"""


def smoothed(seen: Seen, pose: PoseEstimate) -> Seen:
    """What is perceived, with the object where it is estimated to be.

    Args:
        seen: What is perceived.
        pose: `GraspState.pose`.
    """
    return seen._replace(p_wo=pose.p_wo, R_wo=pose.R_wo)


def to_object(points: ThreePoints, seen: Seen) -> ThreePoints:
    """World points in the object frame."""
    position = turned_back(seen.R_wo, points.position - seen.p_wo)
    return ThreePoints(position, turned_back(seen.R_wo, points.normal))


def to_world(points: ThreePoints, seen: Seen) -> ThreePoints:
    """Points of the object frame where the object is tracked."""
    position = seen.p_wo + turned(seen.R_wo, points.position)
    return ThreePoints(position, turned(seen.R_wo, points.normal))
