"""What follows a training: evaluation against its baselines, and the recording of a grasp."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from mjx_grasp.evaluation.conditions import BEGAN_WITH, read_groups
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.run import evaluate, model_based
from mjx_grasp.evaluation.tables import success_table, untrained_note
from mjx_grasp.evaluation.trajectory import Trajectory, record_world, save_trajectory
from mjx_grasp.evaluation.trials import Trials, incidents, paired_draws, record_trials
from mjx_grasp.evaluation.verdict import result_table, verdict
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.learning.controller import deployed_task, policy_task
from mjx_grasp.learning.policy import Policy, load_policy
from mjx_grasp.records.provenance import provenance
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig, build_scene
from mjx_grasp.tasks.assemble import TaskConfig, World, build_world
from mjx_grasp.tasks.config import EndToEndConfig, StartNoise
from mjx_grasp.training.config import TrainConfig
from mjx_grasp.training.start import start_policy

SQUEEZE_FORCES_N = (3.0, 5.0, 8.0)
GRIP_FRICTIONS = (0.4, 0.7)
"""μ₀ of the grips beside a policy that adds to one: each is a point of the grip's front."""
FORCE_BUDGETS_N = (1.5, 3.0)
"""That a policy which knows a budget is given."""


def evaluate_run(
    folder: Path,
    config: TrainConfig,
    world: World,
    states: HandoffSet,
    console: Console,
    command: str | None = None,
) -> None:
    """Evaluates in native MuJoCo on states that the training did not see: results.json, grasp.npz.

    Args:
        folder: The run.
        config: Its configuration.
        world: Its scene.
        states: Start states kept for evaluation.
        console: For progress and the table.
        command: See `run_training`.
    """
    policy = load_policy(folder / "policy.npz")
    exact = SceneConfig().physics_dt  # a training may step more coarsely than it is judged
    every_joint = replace(config.scene, fix_idle_fingers=False, physics_dt=exact)
    scene = build_scene(world.scene.objects, load_robot(config.robot), every_joint)
    task, base = policy_task(policy), condition(config, folder / "results.json")
    held_out = build_world(scene, states, task.control_dt)
    rows: list[ResultRow] = []
    runs: list[Trials] = []
    # Without a policy nothing reaches: what the policy is compared with begins at the handoffs.
    alone = task.closing if isinstance(task, EndToEndConfig) else task
    others = baselines(base, alone)
    budgets = FORCE_BUDGETS_N if task.observation.budget else (base.force_budget,)
    policies = {None: policy, BEGAN_WITH: start_policy(replace(config, resume=folder), scene.robot)}
    own = [
        (replace(base, force_budget=budget), controller, name)
        for name, controller in policies.items()
        if controller is not None
        for budget in budgets
    ]
    for chosen, controller, name in (*own, *((other, None, None) for other in others)):
        new, trials = evaluate(
            held_out, states.object_names, chosen, controller, states.reached, console, alone
        )
        rows += [replace(row, label=name) for row in new]
        runs += trials.values()
    label, counted = f"policy, preset {config.preset}", incidents(runs)
    made = provenance(config.seed, command)
    robot = scene.robot.identity
    adds_to_squeeze = alone is task and not answers_to_load(task)
    untrained = {"untrained_n": task.grip.force} if adds_to_squeeze else {}
    of = {"label": label, "scans": config.scans}
    write_results(base.out, rows, made, robot, **of, **untrained, **counted)
    console.print(success_table(rows, scans=config.scans))
    for force in untrained.values():
        console.print(untrained_note(force))
    groups = read_groups([base.out])
    if (result := result_table(groups)).rows:
        console.print(result)
    for sentence in verdict(groups):
        console.print(sentence)

    shown = best_grasp(held_out, states.object_names[0], policy, config.noise, base.seed)
    save_trajectory(folder / "grasp.npz", shown)


def condition(config: TrainConfig, out: Path) -> EvaluateConfig:
    """The training's own condition, for its evaluation; its objects have their own mass.

    Args:
        config: The training.
        out: Results file.
    """
    noise = config.noise
    least, most = noise.friction
    return EvaluateConfig(
        out=out,
        episodes=config.evaluation_episodes,
        seed=(config.seed + 1) % 2**32,
        friction=(least + most) / 2,
        friction_spread=(most - least) / 2,
        offset_mm=1e3 * noise.offset_m,
        angle_deg=math.degrees(noise.angle_rad),
    )


def answers_to_load(task: TaskConfig) -> bool:
    """Whether the command that a policy adds to is another one than a squeeze's."""
    squeeze = EvaluateConfig(Path("unused.json"), "squeeze", squeeze_force=task.grip.force)
    return model_based(task, squeeze) != task


def baselines(base: EvaluateConfig, task: TaskConfig) -> list[EvaluateConfig]:
    """What a policy is compared with: squeezes, and grips like its own command if that is one.

    Args:
        base: The condition.
        task: Whose command the policy adds to: before training it adds nothing.
    """
    answers = answers_to_load(task)
    forces = sorted({*SQUEEZE_FORCES_N, *(() if answers else (task.grip.force,))})
    grips = [replace(task.grip, friction=friction) for friction in GRIP_FRICTIONS]
    return [
        *(replace(base, controller="squeeze", squeeze_force=force) for force in forces),
        *(replace(base, controller="grip", grip=grip) for grip in grips if answers),
    ]


def best_grasp(world: World, name: str, policy: Policy, noise: StartNoise, seed: int) -> Trajectory:
    """A recorded episode of the policy on an object, a successful one if there is any among eight.

    Args:
        world: Scene and start states.
        name: An object with start states.
        policy: The policy.
        noise: Of the starts.
        seed: Of the starts.
    """
    task = deployed_task(policy)
    run = world.task("mujoco", 8, task, noise, with_privileged=False)
    draw = paired_draws(world.starts, [world.scene.object_index(name)], 8, noise, seed)
    trials, qpos = record_trials(run, policy.controller(), draw)
    best = int(np.argmax(trials.success))
    return record_world(world.scene, name, qpos[:, best], task.control_dt)
