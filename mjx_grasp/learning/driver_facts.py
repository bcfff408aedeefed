"""What a driver has to know of a policy that runs elsewhere, as texts of JSON by name."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_grasp.learning.controller import check_deployable, deployed_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.records.provenance import command_line, file_digests, git_revision, versions
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.tasks.layout import Segment, action_layout, observation_layout

VERSION = 1
"""Of the names and their meaning."""


def driver_facts(policy: Policy, file: Path, robot: RobotSpec) -> dict[str, str]:
    """Everything that a driver needs beside the network.

    Args:
        policy: The policy.
        file: Where it was read.
        robot: The robot that it drives.

    Returns:
        Texts of JSON by name: `format`, `robot`, `joints`, `observed_joints`, `acted_joints`,
        `control`, `observation`, `action`, `force_budget`, `task`, `policy`, `exported`.

    Raises:
        FileError: It reads what no robot knows.
    """
    task = deployed_task(policy)
    check_deployable(file, task)
    observed, acted = observation_layout(robot, task), action_layout(robot, task)
    facts = {
        "format": {"name": "mjx_grasp policy export", "version": VERSION},
        "robot": to_record(robot.identity),
        "joints": joint_facts(robot),
        "observed_joints": _joints(observed, "rad"),
        "acted_joints": _joints(acted, "rad/s"),
        "control": {"period_s": task.control_dt, "rate_hz": 1.0 / task.control_dt},
        "observation": {"size": policy.observation_size, "segments": to_record(observed)},
        "action": {
            "size": policy.action_size,
            "limits": [-1.0, 1.0],
            "segments": to_record(acted),
            "law": to_record(task.action),
        },
        "force_budget": budget_facts(policy, observed),
        "task": to_record(task),
        "policy": {k: v for k, v in policy.meta.items() if k != "task"} | file_digests(sha256=file),
        "exported": {"command": command_line(), "git": git_revision(), "versions": versions()},
    }
    return {name: json.dumps(_finite(fact), allow_nan=False) for name, fact in facts.items()}


def _finite(fact: Any) -> Any:
    """The same with null for what is infinite, a word in records of settings: no limit."""
    match fact:
        case dict():
            return {name: _finite(value) for name, value in fact.items()}
        case list() | tuple():
            return [_finite(value) for value in fact]
        case "inf" | "-inf":
            return None
        case float() if not math.isfinite(fact):
            return None
    return fact


def _joints(segments: Sequence[Segment], unit: str) -> tuple[str, ...]:
    """The joints whose position is read, or that are moved, in their order."""
    return tuple(dict.fromkeys(n for part in segments if part.unit == unit for n in part.of))


def joint_facts(robot: RobotSpec) -> list[dict[str, Any]]:
    """Of each joint, in the order of commands: gains and limits of its position control."""
    model = robot_mjspec(robot).compile()
    facts = []
    for name, velocity in zip(robot.joints, robot.velocity_limits, strict=True):
        actuator, joint = model.actuator(name), model.joint(name)
        limited = model.actuator_forcelimited[actuator.id]
        facts.append(
            {
                "name": name,
                "kp_n_m_per_rad": float(actuator.gainprm[0]),
                "kv_n_m_s_per_rad": -float(actuator.biasprm[2]),
                "torque_limit_n_m": actuator.forcerange.tolist() if limited else None,
                "position_limit_rad": joint.range.tolist(),
                "velocity_limit_rad_per_s": velocity,
            }
        )
    return facts


def budget_facts(policy: Policy, observed: tuple[Segment, ...]) -> dict[str, Any] | None:
    """The range of force budgets that it was trained with; none if it is given no budget.

    Policies that do not say it have it in the statistics of what they observed: budgets are drawn
    uniformly, so that the range is the mean ± √3 standard deviations.

    Args:
        policy: The policy.
        observed: The layout of its observations.
    """
    part = next((part for part in observed if part.what == "force_budget"), None)
    if part is None:
        return None
    if "noise" in policy.meta:
        low, high = policy.meta["noise"]["budget_n"]
        return {"range_n": [low, high], "known_from": "the training's settings"}
    middle, half = policy.mean[part.start], np.sqrt(3.0) * policy.std[part.start]
    bounds = [round(part.one * float(bound), 2) for bound in (middle - half, middle + half)]
    return {"range_n": bounds, "known_from": "the statistics of its observations"}
