"""What an error of the object's pose at the handoff costs: success over a grid of errors.

The hand stands at its handoff while the object is moved sideways by up to so much along x and y and
turned by up to so much about a random axis, which is what a wrong pose is to a policy that does not
see. All controllers have the same draws. A controller that is in the file already, of the same
settings and revision of the code, is left alone, so that an interrupted run goes on.

  python experiments/pose_error.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.evaluation.run import outcome_letters
from mjx_grasp.evaluation.trials import Trials, paired_draws, run_trials, zero_controller
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.records.atomic import check_writable, read_json, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import (
    CommandSettings,
    Count,
    NonNegative,
    Positive,
    Seed,
    to_record,
)
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.tasks.starts import StartDraw

SCHEMA = "mjx_grasp.pose_error/1"


@dataclass(frozen=True)
class PoseErrorConfig(CommandSettings):
    """Which controllers, and which errors."""

    out: Path = Path("experiments/results/pose_error.json")
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    offsets_mm: tuple[NonNegative, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    angles_deg: tuple[NonNegative, ...] = (0.0, 5.0, 10.0)
    budgets: tuple[Positive, ...] = (3.0,)
    """force budgets of the policy [N]"""
    squeezes: tuple[Positive, ...] = (3.0, 5.0)
    """forces of the squeeze [N]"""
    episodes: Count = 16
    """of each object under each error [-]"""
    seed: Seed = 0


def noises(config: PoseErrorConfig) -> dict[tuple[float, float], StartNoise]:
    """What is drawn in each cell of the grid."""
    return {
        (offset, angle): StartNoise(offset_m=1e-3 * offset, angle_rad=math.radians(angle))
        for angle in config.angles_deg
        for offset in config.offsets_mm
    }


def controllers(config: PoseErrorConfig) -> dict[str, tuple[str, float]]:
    """What to compare: how each is called, its kind, its force."""
    return (
        {f"policy, budget {budget:g} N": ("policy", budget) for budget in config.budgets}
        | {f"squeeze {force:g} N": ("squeeze", force) for force in config.squeezes}
        | {"grip": ("grip", REACTING.force)}
    )


def cells(
    trials: Trials,
    grid: list[tuple[float, float]],
    names: list[str],
    episodes: int,
) -> list[dict[str, Any]]:
    """One row per error and object, of trials in that order."""
    letters = outcome_letters(trials)
    rows = []
    for k, ((offset, angle), name) in enumerate((at, n) for at in grid for n in names):
        of = slice(k * episodes, (k + 1) * episodes)
        rows.append(
            {
                "offset_mm": offset,
                "angle_deg": angle,
                "object": name,
                "outcomes": "".join(letters[of]),
                "starts": trials.row[of].tolist(),
                "forces_n": _rounded(trials.force_mean[of]),
            }
        )
    return rows


def _rounded(forces: Float[np.ndarray, " n"]) -> list[float | None]:
    return [None if np.isnan(x) else round(float(x), 3) for x in forces]


def joined(draws: list[StartDraw]) -> StartDraw:
    """Draws one after the other."""
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *draws)


def main(config: PoseErrorConfig) -> None:
    """Runs what is not there yet."""
    check_writable("--out", config.out)
    made, robot, console = provenance(config.seed), load_robot(), Console(stderr=True)
    policy_file = config.policy or asset_path("policy.npz")
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    policy, stored = load_controller(policy_file, robot), load_handoffs(handoffs, robot=robot)
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "settings": to_record(config),
        "sha256": file_digests(policy=policy_file, handoffs=handoffs),
        "controllers": {},
        "provenance": made,
    }
    if config.out.exists():
        before = read_json(config.out, "a table of pose errors")
        same = all(before.get(n) == record[n] for n in ("schema", "settings", "sha256"))
        if same and before["provenance"]["git"] == made["git"]:
            record = before
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig())
    names, _ = eligible(scene.object_names, stored)
    states = states_of(stored, names, "evaluation")
    world = build_world(scene, states, TaskConfig().control_dt)
    left = {n: c for n, c in controllers(config).items() if n not in record["controllers"]}
    with counting_progress(console) as bar:
        job = bar.add_task("controllers", total=len(left))
        for name, (kind, force) in left.items():
            base = policy_task(policy) if kind == "policy" else TaskConfig()
            if kind != "policy":
                grip = REACTING if kind == "grip" else GripConfig(force=force)
                base = replace(base, grip=grip)
            act = (lambda obs: policy(obs["state"])) if kind == "policy" else None
            record["controllers"][name] = _ran(world, names, base, act, force, config)
            write_json(config.out, record)
            bar.update(job, advance=1)


def _ran(
    world: World,
    names: list[str],
    task: TaskConfig,
    act: Any,
    budget: float,
    config: PoseErrorConfig,
) -> list[dict[str, Any]]:
    """All cells of one controller."""
    grid = noises(config)
    draws = [
        paired_draws(
            world.starts,
            world.scene.object_index(name),
            config.episodes,
            replace(noise, budget_n=(budget, budget)),
            config.seed,
        )
        for noise in grid.values()
        for name in names
    ]
    # The noise tells the task whether objects are turned; the draws say by how much.
    widest = StartNoise(angle_rad=math.radians(max(config.angles_deg)))
    worlds = config.episodes * len(names)
    run = world.task("mujoco", worlds, task, widest, with_privileged=False)
    trials = run_trials(run, act or zero_controller(run), joined(draws), worlds)
    return cells(trials, list(grid), names, config.episodes)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PoseErrorConfig, description=__doc__)))
