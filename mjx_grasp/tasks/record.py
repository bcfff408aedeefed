"""The task that a file describes, whichever version wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import from_record
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig


def task_from_record(record: Any) -> ClosingTaskConfig:
    """The task that a file describes, of today or of when all its numbers were one flat list.

    A record without `kind` is the closing task's.

    Args:
        record: Values of JSON.

    Raises:
        InputError: An unknown field, an impossible value, or a flat list that is not whole.
    """
    if isinstance(record, Mapping) and not _ONLY_FLAT.isdisjoint(record):
        record = _nested(record)
    other = isinstance(record, Mapping) and "kind" in record
    return from_record(EndToEndConfig if other else ClosingTaskConfig, record, "task")


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The flat record of the first policies, sorted into today's parts."""
    for name in (*sorted(flat.keys() - _FLAT.keys()), *sorted(_FLAT.keys() - flat.keys())):
        expected = "all fields of the first version's task and no others"
        raise InputError(f"task.{name}", flat.get(name, "nothing"), expected)
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *parts, last = _FLAT[name].split(".")
        at = nested
        for part in parts:
            at = at.setdefault(part, {})
        at[last] = value
    return nested


# Where each field of the flat record stands now.
_FLAT = {
    "control_dt": "control_dt",
    "episode_s": "episode_s",
    "finger_action_rate": "action.finger_rate",
    "arm_action_rate": "action.arm_rate",
    "residual": "action.residual",
    "residual_keep": "action.keep",
    "residual_limit": "action.limit",
    "grip_force": "grip.force",
    "grip_ramp_s": "grip.ramp_s",
    "arrival_distance": "grip.arrival",
    "grip_together": "grip.together",
    "approach_s": "grip.approach_s",
    "command_angular_weight": "guidance.turn_weight",
    "hold_lead": "guidance.lead",
    "finger_damping": "guidance.damping",
    "finger_rate_limit": "guidance.rate_limit",
    "arm_damping": "lift.damping",
    "guidance_speed": "guidance.speed",
    "guidance_slowdown": "guidance.slowdown",
    "guidance_return": "guidance.return_rate",
    "guidance_turn": "guidance.turn_rate",
    "angular_weight": "reward.turn_weight",
    "lift_speed": "lift.speed",
    "lift_height": "lift.height",
    "lift_ramp_s": "lift.ramp_s",
    "lift_delay_s": "lift.delay_s",
    "acquisition_s": "stages.acquisition_s",
    "acquisition_fingers": "stages.fingers",
    "reach_weight": "reward.reach",
    "reach_scale": "reward.reach_scale",
    "reach_floor": "reward.reach_floor",
    "contact_weight": "reward.contact",
    "lift_weight": "reward.lift",
    "lift_reward_scale": "reward.lift_scale",
    "action_rate_weight": "reward.action_rate",
    "action_acceleration_weight": "reward.action_acceleration",
    "observer_gain": "observer.gain",
    "stall_speed": "observer.stall_speed",
    "contact_torque": "observer.contact_torque",
    "contact_ticks": "observer.contact_ticks",
    "stop_margin": "observer.stop_margin",
    "success_height": "success.height",
    "success_hold_s": "success.hold_s",
    "success_slip": "success.slip",
}
_ONLY_FLAT = {old for old, new in _FLAT.items() if old != new}
