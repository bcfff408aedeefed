"""An evaluation as a whole: from its settings to its results file."""

from __future__ import annotations

from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.run import chosen_states, evaluate
from mjx_grasp.evaluation.trials import incidents
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.records.atomic import check_writable
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, build_scene_of, build_world


def evaluate_to_file(config: EvaluateConfig, console: Console) -> list[ResultRow]:
    """Evaluates a controller and writes the results file.

    Args:
        config: Controller, objects, condition, files.
        console: For progress and warnings.

    Returns:
        The rows of the file, one per object.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_writable("--out", config.out)
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    robot = load_robot(config.robot)
    file = config.policy or asset_path("policy.npz") if config.controller == "policy" else None
    policy = None if file is None else load_controller(file, robot)
    stored = load_handoffs(handoffs, robot=robot)
    names, without, states = chosen_states(stored, config)
    if without:
        console.print(f"[yellow]no start states, left out: {', '.join(without)}[/yellow]")
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig(), config.weight)
    task = policy_task(policy) if policy else TaskConfig()
    world = build_world(scene, states, task.control_dt)
    rows, trials = evaluate(world, names, config, policy, states.reached, console)
    write_results(
        config.out,
        rows,
        provenance(config.seed),
        robot.identity,
        not_eligible=without,
        settings=to_record(config),
        sha256=file_digests(policy=file, handoffs=handoffs),
        **incidents(trials.values()),
    )
    return rows
