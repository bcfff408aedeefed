"""Every number of the online selection, in one place."""

from __future__ import annotations

from dataclasses import dataclass

from mjx_grasp.errors import InputError


@dataclass(frozen=True)
class TargetConfig:
    """Where the tips are to be when the policy takes over (method §2 'Targets', §4)."""

    thumb_standoff: float = 0.025
    """distance of the thumb's tip frame from its contact, along the outward normal [m]"""
    wrap_standoff: float = 0.040
    """the same for the index and middle finger [m]"""
    wrap_spread: float = 0.020
    """half distance between the two wrap targets [m]"""
    min_axis_angle: float = 0.1
    """|u × g| below which a reach direction does not spread the wraps [-]"""
    min_height: float = 0.015
    """no contact or target lower than this above the table [m]"""


@dataclass(frozen=True)
class SelectionConfig:
    """Weights, rejections and hysteresis (method §2)."""

    angle_weight: float = 0.1
    """of the angle between palm and grasp axis [m/rad]"""
    score_weight: float = 0.1
    """of the heatmap's score [m]"""
    span_weight: float = 1.0
    """of the difference of the candidate's width and the hand's span [-]"""
    hysteresis: float = 0.03
    """a running choice is left only for one that is better by this [m]"""
    swap_angle: float = 0.25
    """the wraps are swapped only if that is closer to the hand by this [rad]"""
    min_height: float = 0.015
    """no contact or target lower than this above the table [m]"""
    min_goal_height: float = -float("inf")
    """nor any standoff target, to which the tips go first; the paper does not ask for this [m]"""
    standoffs: tuple[float, float] = (0.025, 0.040)
    """of thumb and wraps outside their contacts, for the above [m]"""
    min_score: float = 0.05
    """candidates below are rejected [-]"""
    min_axis_angle: float = 0.1
    """|u × g| below which a reach direction does not spread the wraps [-]"""
    wrap_spread: float = 0.020
    """half distance between the two wrap targets [m]"""

    def __post_init__(self):
        for name in ("hysteresis", "swap_angle", "wrap_spread"):
            if not getattr(self, name) >= 0:
                raise InputError(name, getattr(self, name), "zero or more")
