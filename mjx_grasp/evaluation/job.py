"""An evaluation as a whole: from its settings to its results file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress
from mjx_grasp.evaluation.config import EvaluateConfig, check_own_settings
from mjx_grasp.evaluation.results import SCHEMAS, ResultRow, write_results
from mjx_grasp.evaluation.run import chosen_states, evaluate
from mjx_grasp.evaluation.trials import incidents
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.records.atomic import check_replaceable
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.records.spread import spread, unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world


class _Evaluation(NamedTuple):
    """What every process of an evaluation needs."""

    config: EvaluateConfig
    robot: RobotSpec
    file: Path | None
    """the policy's"""
    policy: Policy | None
    handoffs: Path
    names: list[str]
    without: list[str]
    """objects without start states"""
    states: HandoffSet
    world: World

    def of(self, names: Sequence[str], console: Console) -> tuple[list[ResultRow], dict[str, int]]:
        """Rows of some of the objects, and incidents."""
        reached = self.states.reached
        rows, trials = evaluate(self.world, names, self.config, self.policy, reached, console)
        return rows, incidents(trials.values())


def _loaded(config: EvaluateConfig) -> _Evaluation:
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    robot = load_robot(config.robot)
    file = config.policy or asset_path("policy.npz") if config.controller == "policy" else None
    policy = None if file is None else load_controller(file, robot)
    stored = load_handoffs(handoffs, robot=robot)
    names, without, states = chosen_states(stored, config)
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig(), config.weight)
    task = policy_task(policy) if policy else TaskConfig()
    world = build_world(scene, states, task.control_dt)
    return _Evaluation(config, robot, file, policy, handoffs, names, without, states, world)


def _of_object(own: _Evaluation, name: str) -> tuple[list[ResultRow], dict[str, int]]:
    return own.of([name], Console(quiet=True))  # the file counts the incidents


def evaluate_to_file(config: EvaluateConfig, console: Console) -> list[ResultRow]:
    """Evaluates a controller and writes the results file.

    Args:
        config: Controller, objects, condition, files, and who shares the objects.
        console: For progress and warnings.

    Returns:
        The rows of the file, one per object.

    Raises:
        InputError, FileError: A setting or file that cannot work; nothing is written then.
    """
    check_replaceable("--out", config.out, [SCHEMAS[ResultRow]])
    check_own_settings(config)
    own = _loaded(config)
    if own.without:
        console.print(f"[yellow]no start states, left out: {', '.join(own.without)}[/yellow]")
    if config.alone:
        rows, counted = own.of(own.names, console)
    else:
        rows, counted = [], dict.fromkeys(incidents(()), 0)
        with counting_progress(console) as bar:
            what = f"{config.controller} in {config.engine}, {config.processes} processes"
            job = bar.add_task(what, total=len(own.names))
            for part, happened in spread(config, _of_object, own.names, partial(_loaded, config)):
                rows += part
                counted = {name: counted[name] + happened[name] for name in counted}
                bar.update(job, advance=1)
    write_results(
        config.out,
        rows,
        provenance(config.seed),
        own.robot.identity,
        not_eligible=own.without,
        settings=to_record(unspread(config)),
        sha256=file_digests(policy=own.file, handoffs=own.handoffs),
        **counted,
    )
    return rows
