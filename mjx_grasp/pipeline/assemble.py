"""A grasper, from a robot and settings."""

from __future__ import annotations

from dataclasses import replace

from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import REACTING, CloserConfig
from mjx_grasp.closing.learned import LearnedPolicy
from mjx_grasp.errors import InputError
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.known import STEERED_AT_LEAST, STEERED_SCORE
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.planning import Planner
from mjx_grasp.reaching.presets import ReachPreset, reach_preset, with_gate
from mjx_grasp.robot.description import RobotSpec


def whole_grasps(
    preset: str = "default", steered: bool = False, approach: Approach = "any"
) -> ReachPreset:
    """A preset of reaching that also looks ahead to what follows it, where it plans at all.

    Postures from which the arm cannot lift straight up, or a finger not touch its contact, come
    last: the farther short, the later. So do fingers that would touch with their side, contacts
    near an edge, beside the centre of mass, and those that need much force; those that no force of
    this hand can hold are not planned for.
    Short ways count more than in reaching alone.

    Args:
        preset: What it is made from.
        steered: Whether the candidates' scores are those of an anchor: then those are used that it
            raises high enough, or reach would decide in its place; see `steered_candidates`. Others
            are where there is no posture for any of them.
        approach: From where the palm is to come.

    Raises:
        InputError: There is no preset of this name, or one that does not plan is told an approach.
    """
    settings = reach_preset(preset)
    if steered:
        selection = replace(settings.selection, min_score=STEERED_SCORE)
        settings = replace(settings, selection=selection)
    if settings.plan is None:
        if approach != "any":
            raise InputError("approach", approach, f"any: the preset {preset} does not plan")
        return settings
    # What follows is known of postures that were solved for alone: no attempt is left behind.
    thorough = PlanConfig()
    plan = replace(
        settings.plan,
        starts=replace(settings.plan.starts, count=thorough.starts.count),
        ik=replace(settings.plan.ik, iterations=thorough.ik.iterations),
        finalists=None,
        retreat_steps=None,
        lift_error=0.03,
        touch_error=0.016,
        haste=6.0,
        touch_weight=600.0,
        pad_weight=20.0,
        lever_weight=250.0,
        hold_weight=8.0,
        must_hold=ContactConfig().friction,
        press_weight=4.0,
        heavier=1.25,
        edge_weight=800.0,
        way_out=0.02,
        lesser_cost=80.0 if steered else 35.0,
        at_least=STEERED_AT_LEAST if steered else (),
        easily=1.45 if steered else float("inf"),
        far_weight=400.0 if steered else 0.0,
        lesser_scores=(0.0,),
        approach=approach,
    )
    gate = replace(settings.reach.controller.gate, stalled_tips=0.035)
    return with_gate(replace(settings, plan=plan), gate)


def grasper_of(
    robot: RobotSpec,
    closing: CloserConfig | None = None,
    policy: LearnedPolicy | None = None,
    reaching: ReachPreset | None = None,
    config: GrasperConfig | None = None,
) -> Grasper:
    """The controller of whole grasps of a robot.

    Args:
        robot: Arm and hand.
        closing: What closes; with a policy that of its training. By default a grip that answers
            to the load that it feels.
        policy: What corrects it; nothing by default.
        reaching: What reaches; by default `whole_grasps`.
        config: From phase to phase.

    Raises:
        InputError: A robot that a part cannot use, or control periods that differ.
    """
    settings = reaching or whole_grasps()
    reacher = Reacher(robot_body(robot), settings.reach, settings.selection)
    planner = None if settings.plan is None else Planner(reacher, settings.plan)
    closing, config = closing or CloserConfig(grip=REACTING), config or GrasperConfig()
    grip = replace(closing.grip, most=max(closing.grip.most, config.most))
    closer = Closer.of(robot, replace(closing, grip=grip))
    return Grasper.of(reacher, closer, config, planner, policy)
