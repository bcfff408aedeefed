"""What each part of the policy's training adds: short runs that differ in one setting.

Each run is one command, and the first of them the preset itself:

  python -m mjx_grasp.train --preset gpu --ppo.iterations 120 --out runs/preset-seed0
  python -m mjx_grasp.train --preset gpu --ppo.iterations 120 --task.reward.held 0 \
    --out runs/unheld-seed0
  python experiments/policy_ablation.py runs/preset-seed0 runs/unheld-seed0

lifts with their policies in native MuJoCo from states of the training set, so that what is chosen
by this table is not chosen by the states that the results are made with. A run that is in the file
already is replaced, unless it was judged alike by the same code, and runs that were judged
otherwise, with other budgets, say, are left out of it; one that was being judged when the
script was killed keeps what was finished of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.run import model_based
from mjx_grasp.evaluation.trials import (
    Controller,
    Trials,
    by_object,
    paired_draws,
    run_trials,
    zero_controller,
)
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.learning.controller import policy_task
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.records.atomic import check_replaceable, read_json, write_json
from mjx_grasp.records.journal import Journal, goes_on
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed, to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world
from mjx_grasp.tasks.config import RobotErrors, StartNoise
from mjx_grasp.training.config import TrainConfig, settings_of, stored_config

SCHEMA = "mjx_grasp.policy_ablation/1"
_OTHER_ROBOT = RobotErrors(stiffness=(0.7, 1.3), latency_s=(0.0, 0.02))
CONDITIONS = {
    "nominal": StartNoise(),
    "hard": StartNoise(offset_m=0.01, friction=(0.5, 0.5)),
    "other robot": StartNoise(robot=_OTHER_ROBOT),
}
_NOT_COMPARED = (
    *("out", "resume", "objects_dir", "handoffs", "handoffs_per_object", "seed", "preset"),
    *("fit_memory", "evaluation_episodes", "loop.checkpoint_every_s"),
)
"""Where a run may differ from its preset and still be trained alike."""


@dataclass(frozen=True)
class AblationConfig(CommandSettings):
    """Which runs to evaluate."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """folders of finished runs, or folders of such folders"""
    out: Path = Path("experiments/results/policy_ablation.json")
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    budgets: tuple[Positive, ...] = (1.0, 2.0, 3.0, 4.0)
    """forces that the policies may take [N]"""
    as_trained: bool = False
    """judge each in one more condition: friction, robot and errors as its own training drew them"""
    squeezes: tuple[Positive, ...] = ()
    """forces of squeezes that are judged, nominally, in the task of each [N]"""
    episodes: Count = 32
    """per object, budget and condition [-]"""
    seed: Seed = 0


def finished_runs(folder: Path) -> list[Path]:
    """A run, or all those in a folder that have a policy.

    Raises:
        FileError: There is none.
    """
    if (folder / "policy.npz").exists():
        return [folder]
    found = sorted(path.parent for path in folder.glob("*/policy.npz"))
    if not found:
        raise FileError(folder, "no policy.npz", "a finished run, or a folder of some")
    return found


def flat(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of a nested record by its name on the command line."""
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def changes(config: TrainConfig) -> dict[str, Any]:
    """The settings in which a run differs from its preset."""
    preset = dict(flat(to_record(settings_of(config.preset))))
    mine = flat(to_record(config))
    return {k: v for k, v in mine if k not in _NOT_COMPARED and preset.get(k) != v}


def evaluated(
    world: World,
    policy_file: Path,
    conditions: Mapping[str, StartNoise],
    config: AblationConfig,
    journal: Journal,
) -> list[dict[str, Any]]:
    """One row per condition and budget; trials that share compiled functions are one batch."""
    policy, digests = load_policy(policy_file), file_digests(policy=policy_file)
    asked = [(name, budget) for name in conditions for budget in config.budgets]
    noises = [replace(conditions[name], budget_n=(budget, budget)) for name, budget in asked]
    task, found = policy_task(policy), []
    for felt, alike in groupby(noises, _felt):
        own = list(alike)
        tried = world, task, policy.controller(), own, felt, config
        found += journal.once(f"{digests}, {own}", _tried, *tried)
    return [
        {"condition": n, "budget_n": b} | sums for (n, b), sums in zip(asked, found, strict=True)
    ]


def squeezed(
    world: World, task: TaskConfig, force: float, config: AblationConfig
) -> dict[str, Any]:
    """What a squeeze lifts in a policy's task, nominally."""
    squeeze = EvaluateConfig(config.out, controller="squeeze", squeeze_force=force)
    own = model_based(task, squeeze)
    nominal = CONDITIONS["nominal"]
    (sums,) = _tried(world, own, None, [nominal], _felt(nominal), config)
    return {"condition": "nominal", "squeeze_n": force} | sums


def _felt(noise: StartNoise) -> StartNoise:
    """What a task is compiled for, so that a condition can be drawn in it.

    That is whether objects are turned, how late commands may be, and errors of torque.
    """
    widest = CONDITIONS["other robot"]
    late = max(noise.robot.latency_s) > max(widest.robot.latency_s)
    return noise if noise.angle_rad or noise.robot.of_torque or late else widest


def _tried(
    world: World,
    own: TaskConfig,
    controller: Controller | None,
    noises: Sequence[StartNoise],
    felt: StartNoise,
    config: AblationConfig,
) -> list[dict[str, Any]]:
    """The figures of each condition; without a controller, of the task's command alone."""
    indices = np.unique(np.asarray(world.starts.object_index)).tolist()
    draws = [
        paired_draws(world.starts, indices, config.episodes, noise, config.seed) for noise in noises
    ]
    draw = jax.tree.map(lambda *parts: jnp.concatenate(parts), *draws)
    size = config.episodes * len(indices)
    task = world.task("mujoco", size, own, felt, with_privileged=False)
    trials = run_trials(task, controller or zero_controller(task), draw, size)
    return [_sums(each, len(indices)) for each in by_object(trials, len(noises))]


def _sums(trials: Trials, objects: int) -> dict[str, Any]:
    """The figures of one condition and budget."""
    force, success = trials.force_mean, trials.success
    held = np.where(success, force, np.inf)
    return {
        "trials": len(success),
        "success_percent": float(100.0 * success.mean()),
        "worst_object_percent": float(100.0 * success.reshape(objects, -1).mean(axis=1).min()),
        "force_mean_n": float(np.nanmean(force)),
        "force_peak_p50_n": float(np.nanmedian(trials.force_peak)),
        "force_peak_p99_n": float(np.nanquantile(trials.force_peak, 0.99)),
        "within_3n_percent": float(100.0 * (held <= 3.0).mean()),
        "within_4n_percent": float(100.0 * (held <= 4.0).mean()),
    }


def main(config: AblationConfig) -> None:
    """Evaluates the runs, one after the other."""
    check_replaceable("--out", config.out, [SCHEMA])
    made = provenance(config.seed)
    folders = [folder for given in config.runs for folder in finished_runs(given)]
    settings = {folder: stored_config(folder) for folder in folders}
    robot = load_robot()
    stored = load_handoffs(config.handoffs or shipped_handoffs(config.objects_dir), robot=robot)
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig())
    names, _ = eligible(scene.object_names, stored)
    world = build_world(scene, states_of(stored, names, "training"), 0.01)
    kept = read_json(config.out, "an ablation table") if config.out.exists() else {"rows": []}
    asked = to_record(replace(config, runs=(), out=Path()))
    rows = {row["run"]: row for row in kept["rows"] if row.get("asked") == asked}
    identity = {"asked": asked, "sha256": file_digests(handoffs=config.handoffs)}
    journal = Journal(config.out, identity, made["git"])

    def squeeze(task: TaskConfig, force: float) -> dict[str, Any]:
        """Once of a task, which many runs share."""
        return journal.once(f"{force} N, {task}", squeezed, world, task, force, config)

    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("runs", total=len(settings))
        for folder, trained in settings.items():
            begun = read_json(folder / "provenance.json", "the provenance of a run")
            files = {"handoffs": config.handoffs, "policy": folder / "policy.npz"}
            judged = {"trained": begun, "asked": asked, "sha256": file_digests(**files)}
            before = rows.get(folder.name, {})
            if "provenance" in before and goes_on(before, judged, made["git"]):
                bar.update(job, advance=1)
                continue
            own = {"as trained": trained.noise} if config.as_trained else {}
            rows[folder.name] = {
                "run": folder.name,
                "changes": changes(trained),
                "seed": trained.seed,
                "env_steps": trained.ppo.iterations * trained.ppo.steps_per_iteration,
                **judged,
                "provenance": made,
                "evaluations": evaluated(
                    world, folder / "policy.npz", CONDITIONS | own, config, journal
                ),
                "squeezes": [squeeze(trained.task, force) for force in config.squeezes],
            }
            record = {
                "schema": SCHEMA,
                "settings": to_record(config),
                "rows": list(rows.values()),
                "provenance": made,
            }
            write_json(config.out, record)
            bar.update(job, advance=1)
    journal.close()


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(AblationConfig, description=__doc__)))
