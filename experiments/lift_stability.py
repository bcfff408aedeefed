"""How still an object is held: its rise, the fingers' forces, and the wrench that is left.

The object is lifted and then held for as long as is asked. Zero is when it has risen by 5 cm. What
is left of the wrench of fingers and weight is the change of its momentum: zero while it hangs
still. `--processes N` shares the controllers, and a run that was killed goes on after those that it
had finished.

  python experiments/lift_stability.py --objects-dir SCANS --handoffs assets/handoffs_reached.npz
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.run import outcome_letters
from mjx_grasp.evaluation.trials import Trials, paired_draws, watch_trials, zero_controller
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, states_of
from mjx_grasp.learning.controller import deployed_task, load_controller
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.objects.momentum import net_wrench
from mjx_grasp.records.atomic import check_writable, replacing, write_json
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Count, NonNegative, Positive, Seed, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world
from mjx_grasp.tasks.closing import ClosingState
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.viz.plots import GREY, new_figure, png, style

SCHEMA = "mjx_grasp.lift_stability/1"
_DT = TaskConfig().control_dt
_COLOURS = {"policy": "#2563a8", "squeeze": "#c8641e", "grip": "#4f7f54"}


@dataclass(frozen=True)
class StabilityConfig(Spread):
    """What to lift, and how long to hold it."""

    out: Path = Path("experiments/results/lift_stability.json")
    picture: Path = Path("docs/lift_stability.png")
    object: str = "potted_meat_can"
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    impratios: tuple[Positive, ...] = (1.0, 10.0)
    """how much stiffer the engine's friction is than its normal force; the picture is of the first
    [-]"""
    seconds: Positive = 14.0
    """of each trial, from the handoff on [s]"""
    budgets: tuple[Positive, ...] = (3.0, 8.0)
    """force budgets of the policy [N]"""
    squeeze: NonNegative = 3.0
    """force of the squeeze [N]"""
    trials: Count = 16
    risen: Positive = 0.05
    """rise at which the clock starts [m]"""
    seed: Seed = 0


class Curves(NamedTuple):
    """What is seen of trials at every tick."""

    rise: Float[np.ndarray, "t n"]
    """of the object origin above where it stood [m]"""
    forces: Float[np.ndarray, "t n f"]
    """contact force of each finger [N]"""
    net_force: Float[np.ndarray, "t n"]
    """mass times acceleration of the centre of mass [N]"""
    net_moment: Float[np.ndarray, "t n"]
    """change of angular momentum about it [N m]"""


def seen(state: ClosingState) -> tuple[Any, ...]:
    """The tick's numbers."""
    truth = state.truth
    return (
        truth.object_pos[:, 2] - state.episode.reset_height,
        jnp.linalg.norm(truth.finger_force, axis=-1),
        truth.object_quat,
        truth.object_vel,
    )


def curves_of(seen: tuple[Any, ...], obj: ObjectModel, dt: float) -> Curves:
    """What is left of the wrench is what the object's momentum does."""
    rise, forces, quat, vel = seen
    left = net_wrench(obj, quat, vel, dt)
    return Curves(rise, forces, *(np.linalg.norm(part, axis=-1) for part in left))


def since_risen(curves: Curves, risen: float, dt: float) -> Float[np.ndarray, "t n"]:
    """Time since each object had risen so far [s]; nan where it never does."""
    high = curves.rise >= risen
    first = np.where(high.any(axis=0), high.argmax(axis=0), np.nan)
    return dt * (np.arange(len(high))[:, None] - first)


def held_for(curves: Curves, risen: float, dt: float) -> Float[np.ndarray, " n"]:
    """How long each object then stays that high without a break, until the trial ends [s]."""
    clock = since_risen(curves, risen, dt)
    fallen = (clock >= 0) & (curves.rise < risen)
    end = np.where(fallen.any(axis=0), fallen.argmax(axis=0), len(clock))
    kept = end * dt + clock[0]
    return np.where(np.isnan(kept), 0.0, kept)


def draw(found: dict[str, Curves], config: StabilityConfig, dt: float) -> bytes:
    """Rise, force per finger and what is left of the wrench, every trial a line, as PNG."""
    figure = new_figure(3.2 * len(found), 8.2)
    axes = figure.subplots(4, len(found), sharex=True, sharey="row", squeeze=False)
    titles = ("rise [m]", "force per finger [N]", "net force [N]", "net moment [N m]")
    for column, (name, curves) in enumerate(found.items()):
        clock, colour = since_risen(curves, config.risen, dt), _COLOURS[name.split(",")[0]]
        mean = curves.forces.mean(axis=-1)
        shown = (curves.rise, mean, curves.net_force, curves.net_moment)
        for ax, title, values in zip(axes[:, column], titles, shown, strict=True):
            style(ax)
            ax.plot(clock, values, color=colour, linewidth=0.7, alpha=0.6)
            ax.set_title(f"{name}: {title}", loc="left", fontsize=9, color=GREY)
            ax.set_ylim(0, None)
        axes[-1, column].set_xlim(-1.0, config.seconds - 2.5)
    figure.supxlabel("time since the object has risen by 5 cm [s]", fontsize=9, color=GREY)
    axes[1, 0].set_ylim(0, 9.0)
    axes[2, 0].set_ylim(0, 6.0)
    axes[3, 0].set_ylim(0, 0.3)
    return png(figure)


class Holds:
    """What every process that lifts and holds needs.

    Args:
        config: What to lift, and for how long.

    Raises:
        InputError, FileError: An object without states, or a file that cannot be read.
    """

    def __init__(self, config: StabilityConfig):
        self._config, self._robot = config, load_robot()
        self.policy_file = config.policy or asset_path("policy.npz")
        self.handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
        self._policy = load_controller(self.policy_file, self._robot)
        stored = load_handoffs(self.handoffs, robot=self._robot)
        if config.object not in stored.object_names:
            known = ", ".join(stored.object_names)
            raise InputError("--object", config.object, f"an object of {self.handoffs}: {known}")
        # As long as is asked; the trained task is otherwise left alone.
        plain = TaskConfig(episode_s=config.seconds)
        trained = replace(deployed_task(self._policy), episode_s=config.seconds)
        squeeze = replace(plain, grip=GripConfig(force=config.squeeze))
        self.tasks = (
            {f"policy, {budget:g} N": (trained, budget) for budget in config.budgets}
            | {f"squeeze, {config.squeeze:g} N": (squeeze, config.squeeze)}
            | {"grip": (replace(plain, grip=REACTING), REACTING.force)}
        )
        """of each controller its task, and the force that it is told or commands [N]"""
        self._states = states_of(stored, [config.object], "evaluation")
        self._world = functools.cache(self._made)

    def hold(self, job: tuple[float, str]) -> dict[str, Any]:
        """Rows of a controller's trials, and their curves where they are drawn."""
        impratio, name = job
        config, world, (task, force) = self._config, self._world(impratio), self.tasks[name]
        noise = StartNoise(budget_n=(force, force))
        start = paired_draws(world.starts, [0], config.trials, noise, config.seed)
        run = world.task("mujoco", config.trials, task, noise, with_privileged=False)
        knows = name.startswith("policy")
        act = self._policy.controller() if knows else zero_controller(run)
        trials, ticks = watch_trials(run, act, start, seen)
        curves = curves_of(ticks, world.scene.objects[0], run.control_dt)
        asked = {"controller": name, "impratio": impratio}
        rows = [asked | row for row in _rows(trials, curves, config, run.control_dt)]
        drawn = curves if impratio == config.impratios[0] else ()
        return {"rows": rows, "curves": [values.tolist() for values in drawn]}

    def _made(self, impratio: float) -> World:
        """The world with so much stiffer friction."""
        config, physics = self._config, SceneConfig(impratio=impratio)
        scene = build_scene_of((config.object,), config.objects_dir, self._robot, physics)
        return build_world(scene, self._states, _DT)


def main(config: StabilityConfig) -> None:
    """Lifts, writes, draws."""
    for name, path in (("--out", config.out), ("--picture", config.picture)):
        check_writable(name, path)
    made, own = provenance(config.seed), Holds(config)
    identity = {
        "schema": SCHEMA,
        "settings": to_record(unspread(config)),
        "sha256": file_digests(policy=own.policy_file, handoffs=own.handoffs),
    }
    jobs = [
        (f"{name}, impratio {impratio}", (impratio, name))
        for impratio in config.impratios
        for name in own.tasks
    ]
    setup = (lambda: own) if config.alone else functools.partial(Holds, config)
    journal = Journal(config.out, identity, made["git"])
    results = journaled(config, Holds.hold, jobs, setup, journal)
    drawn: dict[str, Curves] = {}
    rows = []
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("controllers", total=len(jobs))
        for (_, (_, name)), found in zip(jobs, results, strict=True):
            rows += found["rows"]
            if found["curves"]:
                drawn[name] = Curves(*map(np.array, found["curves"]))
            bar.update(job, advance=1)
    write_json(config.out, identity | {"rows": rows, "provenance": made})
    with replacing(config.picture) as temporary:
        temporary.write_bytes(draw(drawn, config, _DT))
    journal.close()


def _rows(
    trials: Trials, curves: Curves, config: StabilityConfig, dt: float
) -> list[dict[str, Any]]:
    """One row per trial: how long it was held, and means from a second after the rise."""
    clock, kept = since_risen(curves, config.risen, dt), held_for(curves, config.risen, dt)
    letters, rows = outcome_letters(trials), []
    for k in range(len(kept)):
        still = (clock[:, k] > 1.0) & (clock[:, k] < kept[k])
        means = {
            "force_n": curves.forces[:, k].mean(axis=-1),
            "net_force_n": curves.net_force[:, k],
            "net_moment_nm": curves.net_moment[:, k],
        }
        rows.append(
            {
                "start": int(trials.row[k]),
                "outcome": str(letters[k]),
                "held_s": round(float(kept[k]), 2),
                "held_to_the_end": bool(kept[k] > 0 and curves.rise[-1, k] >= config.risen),
            }
            | {
                n: round(float(x[still].mean()), 4) if still.any() else None
                for n, x in means.items()
            }
        )
    return rows


if __name__ == "__main__":
    import lift_stability as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.StabilityConfig, description=__doc__)))
