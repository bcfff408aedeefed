"""Every number of the online selection and of the targets, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from mjx_grasp.records.settings import Finite, NonNegative, Range, Settings, Share


@dataclass(frozen=True)
class TargetConfig(Settings):
    """Where the tips are to be when the policy takes over (method §2 'Targets', §4)."""

    thumb_standoff: NonNegative = 0.025
    """distance of the thumb's tip frame from its contact, along the outward normal [m]"""
    wrap_standoff: NonNegative = 0.040
    """the same for the index and middle finger [m]"""
    wrap_spread: NonNegative = 0.020
    """half distance between the two wrap targets [m]"""
    min_axis_angle: Share = 0.1
    """|u × g| below which a reach direction does not spread the wraps [-]"""
    min_height: Finite = 0.015
    """no contact or target lower than this above the table [m]"""
    min_goal_height: Annotated[float, Range(high=1, finite=False)] = -float("inf")
    """nor any standoff target, to which the tips go first; the paper does not ask for this [m]"""


@dataclass(frozen=True)
class SelectionConfig(Settings):
    """Weights, rejections and hysteresis (method §2)."""

    angle_weight: NonNegative = 0.1
    """of the angle between palm and grasp axis [m/rad]"""
    score_weight: NonNegative = 0.1
    """of the heatmap's score [m]"""
    span_weight: NonNegative = 1.0
    """of the difference of the candidate's width and the hand's span [-]"""
    hysteresis: NonNegative = 0.03
    """a running choice is left only for one that is better by this [m]"""
    swap_angle: NonNegative = 0.25
    """the wraps are swapped only if that is closer to the hand by this [rad]"""
    min_score: NonNegative = 0.05
    """candidates below are rejected [-]"""
    targets: TargetConfig = field(default_factory=TargetConfig)
    """what the candidate is grasped by, and how high that must be"""
