"""`python -m mjx_grasp.evaluate`: success, failures and forces of a controller, as a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mjx_grasp.assets import asset_path
from mjx_grasp.atomic import as_json, check_writable
from mjx_grasp.cli import run_command
from mjx_grasp.closing.assemble import Engine, World, build_scene_of, build_world
from mjx_grasp.closing.config import MAX_ANGLE_RAD, MAX_OFFSET_M, ClosingConfig, StartNoise
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.evaluation.tables import success_table
from mjx_grasp.evaluation.trials import (
    Trials,
    incidents,
    paired_draws,
    run_trials,
    zero_controller,
)
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.learning.policy import Policy, load_policy
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.provenance import file_digests, provenance
from mjx_grasp.sim.scene import SceneConfig


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluates a controller by the criterion of success (method §7)."""

    out: Path
    """Results file (JSON)."""
    controller: Literal["policy", "squeeze"] = "policy"
    objects: tuple[str, ...] = ("eight",)
    """Objects or groups (eight, train, held_out, all); those without start states are reported."""
    objects_dir: Path | None = None
    """Folder of real scans; parametric stand-ins without one."""
    episodes: int = 64
    """Episodes per object."""
    engine: Engine = "mujoco"
    seed: int = 0
    policy: Path | None = None
    """Policy file; the shipped one by default."""
    handoffs: Path | None = None
    """Handoff set; the shipped one by default."""
    states: Literal["evaluation", "training", "all"] = "evaluation"
    """Which part of the handoff set: by default the states that no training sees."""
    squeeze_force: float = 3.0
    """Commanded force per finger of the squeeze [N]."""
    offset_mm: float = 5.0
    """Lateral object offset, uniform in ± this along x and y [mm]."""
    angle_deg: float = 0.0
    """Object rotation about a random axis, uniform up to this [deg]."""
    friction: float = 0.8
    """Sliding friction of the object's contacts [-]."""
    worlds: int = 256
    """Worlds per batch."""

    def __post_init__(self):
        if self.episodes < 1:
            raise InputError("--episodes", self.episodes, "at least 1")
        if self.worlds < 1:
            raise InputError("--worlds", self.worlds, "at least 1")
        if not 0 <= self.squeeze_force < math.inf:
            raise InputError("--squeeze-force", self.squeeze_force, "0 N or more")
        if not 0 <= self.offset_mm * 1e-3 <= MAX_OFFSET_M:
            raise InputError("--offset-mm", self.offset_mm, f"0 to {1e3 * MAX_OFFSET_M:g} mm")
        if not 0 <= math.radians(self.angle_deg) <= MAX_ANGLE_RAD:
            most = math.degrees(MAX_ANGLE_RAD)
            raise InputError("--angle-deg", self.angle_deg, f"0 to {most:.1f} degrees")
        if not 0 < self.friction < math.inf:
            raise InputError("--friction", self.friction, "a positive number")

    @property
    def noise(self) -> StartNoise:
        """The condition as the environment's noise."""
        return StartNoise(
            offset_m=self.offset_mm * 1e-3,
            angle_rad=math.radians(self.angle_deg),
            friction=(self.friction, self.friction),
        )


def evaluate(
    world: World,
    names: Sequence[str],
    config: EvaluateConfig,
    policy: Policy | None,
    handoff_kind: str,
    console: Console,
) -> tuple[list[ResultRow], dict[str, Trials]]:
    """Runs the trials of each object, sums them up and warns of what the engine could not do.

    Args:
        world: Scene and start states.
        names: Objects, all of them with start states.
        config: Controller, engine and condition.
        policy: The policy, for the controller `policy`.
        handoff_kind: `ik` or `reached`, for the rows.
        console: Where the progress bar and warnings go.
    """
    task = policy_task(policy) if policy else ClosingConfig(grip_force=config.squeeze_force)
    worlds = min(config.worlds, config.episodes)
    env = world.env(config.engine, worlds, task, config.noise, with_privileged=False)
    controller = (lambda obs: policy(obs["state"])) if policy else zero_controller(env)
    rows, trials = [], {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console) as bar:
        job = bar.add_task(f"{config.controller} in {config.engine}", total=len(names))
        for name in names:
            index = world.scene.object_index(name)
            draw = paired_draws(world.starts, index, config.episodes, config.noise, config.seed)
            trials[name] = run_trials(env, controller, draw, worlds)
            rows.append(summarise(name, trials[name], config, handoff_kind))
            _warn(name, trials[name], console)
            bar.update(job, advance=1)
    return rows, trials


def policy_task(policy: Policy) -> ClosingConfig:
    """The task a policy was trained in, as its file says."""
    return ClosingConfig(**policy.meta["task"])


def summarise(name: str, trials: Trials, config: EvaluateConfig, handoff_kind: str) -> ResultRow:
    """One row of a results file."""
    n, successes = len(trials.success), int(trials.success.sum())
    lifted = ~np.isnan(trials.force_mean)
    squeeze = config.controller == "squeeze"
    return ResultRow(
        object=name,
        controller=config.controller,
        engine=config.engine,
        episodes=n,
        successes=successes,
        never_lifted=int(trials.never_lifted.sum()),
        not_held=int(trials.not_held.sum()),
        slipped=int(trials.slipped.sum()),
        ci95=wilson_interval(successes, n),
        force_mean_n=float(trials.force_mean[lifted].mean()) if lifted.any() else None,
        force_peak_n=float(trials.force_peak[lifted].max()) if lifted.any() else None,
        squeeze_force_n=config.squeeze_force if squeeze else None,
        offset_mm=config.offset_mm,
        angle_deg=config.angle_deg,
        friction=config.friction,
        handoffs=handoff_kind,
    )


def _warn(name: str, trials: Trials, console: Console) -> None:
    """Says which trials cannot be trusted: contacts were left out, or the numbers were none."""
    counted, n = incidents([trials]), len(trials.success)
    if counted["overflows"]:
        hit = int((trials.overflow_ticks > 0).sum())
        console.print(
            f"[yellow]{name}: {counted['overflows']} buffer overflows in {hit} of {n} trials; "
            "contacts were left out[/yellow]"
        )
    if counted["broken_worlds"]:
        console.print(
            f"[yellow]{name}: {counted['broken_worlds']} of {n} worlds broken; "
            "their states stopped being finite[/yellow]"
        )


def shipped_handoffs(objects_dir: Path | None) -> Path:
    """The shipped handoff set of the eight: for real scans with a folder, else for stand-ins."""
    return asset_path("handoffs_standins.npz" if objects_dir is None else "handoffs_scans.npz")


def eligible(names: Sequence[str], handoffs: HandoffSet) -> tuple[list[str], list[str]]:
    """Splits objects into those with start states and those without."""
    have = set(np.asarray(handoffs.object_names)[np.unique(handoffs.object_index)])
    return [n for n in names if n in have], [n for n in names if n not in have]


def states_of(handoffs: HandoffSet, names: Sequence[str], part: str) -> HandoffSet:
    """The named objects' states of a part of the set."""
    chosen = handoffs.select(names)
    if part == "all":
        return chosen
    training, evaluation = chosen.split()
    return training if part == "training" else evaluation


def chosen_states(
    stored: HandoffSet, config: EvaluateConfig
) -> tuple[list[str], list[str], HandoffSet]:
    """The objects that can be evaluated, those that cannot, and the former's states.

    Raises:
        InputError: An unknown object, or none with states in the part of the set.
    """
    asked = resolve(config.objects)
    part = states_of(stored, [n for n in asked if n in stored.object_names], config.states)
    names, without = eligible(asked, part)
    if not names:
        counts = states_of(stored, stored.object_names, config.states).counts()
        known = ", ".join(n for n in counts if counts[n]) or "none"
        raise InputError("--objects", ", ".join(asked), f"objects with start states ({known})")
    return names, without, part.select(names)


def main(config: EvaluateConfig) -> None:
    """The command."""
    console = Console(stderr=True)
    check_writable("--out", config.out)
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    file = config.policy or asset_path("policy.npz") if config.controller == "policy" else None
    policy = None if file is None else load_policy(file)
    stored = load_handoffs(handoffs)
    names, without, states = chosen_states(stored, config)
    if without:
        console.print(f"[yellow]no start states, left out: {', '.join(without)}[/yellow]")
    scene = build_scene_of(config.objects, config.objects_dir, SceneConfig())
    world = build_world(scene, states, ClosingConfig())
    rows, trials = evaluate(world, names, config, policy, stored.kind, console)
    write_results(
        config.out,
        rows,
        provenance(config.seed),
        not_eligible=without,
        settings=as_json(asdict(config)),
        sha256=file_digests(policy=file, handoffs=handoffs),
        **incidents(trials.values()),
    )
    Console().print(success_table(rows))
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(EvaluateConfig, description=__doc__)))
