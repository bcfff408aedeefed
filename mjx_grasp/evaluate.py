"""`python -m mjx_grasp.evaluate`: success, failures and forces of a controller, as a file."""

from __future__ import annotations

from dataclasses import asdict

import tyro
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import write_results
from mjx_grasp.evaluation.run import chosen_states, evaluate, load_controller, policy_task
from mjx_grasp.evaluation.tables import success_table
from mjx_grasp.evaluation.trials import incidents
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs
from mjx_grasp.records.atomic import as_json, check_writable
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, build_scene_of, build_world


def main(config: EvaluateConfig) -> None:
    """The command."""
    console = Console(stderr=True)
    check_writable("--out", config.out)
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    robot = load_robot(config.robot)
    file = config.policy or asset_path("policy.npz") if config.controller == "policy" else None
    policy = None if file is None else load_controller(file, robot)
    stored = load_handoffs(handoffs, robot=robot)
    names, without, states = chosen_states(stored, config)
    if without:
        console.print(f"[yellow]no start states, left out: {', '.join(without)}[/yellow]")
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig())
    task = policy_task(policy) if policy else TaskConfig()
    world = build_world(scene, states, task.control_dt)
    rows, trials = evaluate(world, names, config, policy, stored.kind, console)
    write_results(
        config.out,
        rows,
        provenance(config.seed),
        robot.identity,
        not_eligible=without,
        settings=as_json(asdict(config)),
        sha256=file_digests(policy=file, handoffs=handoffs),
        **incidents(trials.values()),
    )
    Console().print(success_table(rows, scans=config.objects_dir is not None))
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(EvaluateConfig, description=__doc__)))
