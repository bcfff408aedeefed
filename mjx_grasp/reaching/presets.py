"""The published controller, and step by step what goes beyond it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.posture.config import IkConfig, StartConfig
from mjx_grasp.reaching.config import HandoffGate, ReachConfig
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.records.settings import Settings


@dataclass(frozen=True)
class ReachPreset(Settings):
    """Settings of everything that reaches."""

    reach: ReachConfig
    """of the controller"""
    selection: SelectionConfig
    """of the candidates, and the targets they give"""
    plan: PlanConfig | None
    """None: the selection does not look ahead."""


def _additions() -> dict[str, ReachPreset]:
    """The presets in the order in which each adds one thing to the one before."""
    paper = ReachPreset(ReachConfig(), SelectionConfig(), None)
    steps = {"paper": paper}

    def add(name: str, **changes: Any) -> None:
        steps[name] = replace(steps[list(steps)[-1]], **changes)

    def reach(**parts: dict[str, Any]) -> ReachConfig:
        last = steps[list(steps)[-1]].reach
        new = {name: replace(getattr(last, name), **fields) for name, fields in parts.items()}
        return replace(last, **new)

    # A standoff target in the table's way cannot be reached, whatever the controller does.
    high = replace(paper.selection.targets, min_goal_height=0.012)
    add("standoffs", selection=replace(paper.selection, targets=high))
    add("escape", reach=reach(solver={"partial_escape": True}))
    add("reachability", plan=PlanConfig(), reach=reach(guide={"enabled": False}))
    add("guide", reach=reach(guide={"enabled": True}, fields={"posture_gain": 8.0}))
    add("straight", reach=reach(fields={"via_points": 0, "slow_down": 0.06}))
    add("clearance", reach=reach(limits={"follow_object": True, "margin": 0.0008}))
    add(
        "default",
        # Fewer attempts, better chosen: starts whose hand is clear of the object, first steps that
        # are damped, and of what they lead to only the best goes on.
        plan=PlanConfig(
            starts=StartConfig(count=16, overlap_weight=3.0, ranked=32),
            ik=IkConfig(iterations=14, damping=0.3),
            finalists=5,
            first_steps=5,
            retreat_steps=5,
            way_samples=1,
        ),
        reach=reach(
            # The hand aligns out there, comes in, and comes to rest without a long tail.
            guide={
                "length": 0.21,
                "palm_gain": 15.0,
                "settled_arm_weight": 0.01,
                "hand_weight": 0.01,
            },
            fields={"slow_down": 0.02, "posture_gain": 15.0},
            controller={
                "reselections": 6,
                "stall_time": 0.5,
                "gate": HandoffGate(tips=0.008, near=0.3),
                "replan_moved": 0.03,
            },
        ),
    )
    return steps


PRESETS = _additions()
"""By name: ``paper``; ``standoffs`` targets must be high enough; ``escape`` from penetration even
where not all clearances can be restored at once; ``reachability``: the selection takes a candidate
for which inverse kinematics found a posture; ``guide``: that posture guides the hand; ``straight``:
the guide is enough, tips need no via-points and slow down later; ``clearance``: half-spaces have a
margin and move with the object, and a command is scaled back where its tick would end too near to
something, which bounds of the nearest points alone do not rule out; ``default``: another plan when
progress stalls, handoff when every tip is near or stays fairly near, plans chosen by the whole way
and from fewer attempts, a longer way in, and a hand that comes to rest sooner."""


GATES = {
    "default": PRESETS["default"].reach.controller.gate,
    "paper": PRESETS["paper"].reach.controller.gate,
    "converged": HandoffGate(midpoint=0.020, tips=0.020, tip_speed=0.025),
}
"""By name: ``default``; ``paper``: the midpoint alone, as soon as it is near; ``converged``: every
tip within the publication's 20 mm and slower than its 0.025 m/s. All are content with 50 mm after
3 s of fine adjustment (method §3, 'Handoff'), the default with 15 mm after a moment."""


def with_gate(settings: ReachPreset, gate: HandoffGate) -> ReachPreset:
    """A preset that hands off by another gate."""
    controller = replace(settings.reach.controller, gate=gate)
    return replace(settings, reach=replace(settings.reach, controller=controller))


def reach_preset(name: str) -> ReachPreset:
    """Settings by name.

    Raises:
        InputError: There is no preset of this name.
    """
    if name not in PRESETS:
        raise InputError("preset", name, f"one of {', '.join(PRESETS)}")
    return PRESETS[name]


def for_sweep(
    settings: ReachPreset, fine_timeout: float = 7.0, timeout: float = 15.0
) -> ReachPreset:
    """No handoff and no cap: a reach ends when the fine timer is at 7 s, or after 15 s (§3).

    The controller's gate still tells when it would have handed off. There is no re-selection at the
    time-out, which would restart the timer; what looks ahead may change its plan earlier, while the
    timer runs on.

    Args:
        settings: Of the controller.
        fine_timeout: Of the fine-adjustment timer, [s].
        timeout: Of the whole reach, [s].
    """
    controller = replace(
        settings.reach.controller,
        hands_off=False,
        fine_timeout=fine_timeout,
        timeout=timeout,
        reselect_late=False,
    )
    return replace(settings, reach=replace(settings.reach, controller=controller))
