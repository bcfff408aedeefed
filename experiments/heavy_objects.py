"""What it takes to lift the heaviest objects: harder grips, and stronger fingers.

The grip that answers to load, up to several forces, on fingers whose torque limits are those of the
robot or a multiple of them. States are those of `experiments/paper.py objects`. `--processes N`
shares the grips, and a run that was killed goes on after those that it had finished.

  python experiments/heavy_objects.py --objects-dir SCANS
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.run import evaluate
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import eligible, states_of
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Count, Positive, Seed, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world

SCHEMA = "mjx_grasp.heavy/1"


@dataclass(frozen=True)
class HeavyConfig(Spread):
    """Which objects, how hard, how strong."""

    objects: tuple[str, ...] = ("bleach_cleanser", "power_drill", "wood_block", "mustard_bottle")
    """objects of the handoff set"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path = Path("runs/paper/reached_all.npz")
    """handoff set"""
    most: tuple[Positive, ...] = (8.0, 16.0)
    """force up to which the load may raise the grip's [N]"""
    finger_torque: tuple[Positive, ...] = (1.0, 2.0, 3.0)
    """factors on the torque limits of the finger joints [-]"""
    episodes: Count = 24
    """of each object with each of them [-]"""
    seed: Seed = 1
    out: Path = Path("experiments/results/heavy_objects.json")


class Grips:
    """What every process that evaluates grips needs.

    Args:
        config: Objects, their states, how many trials.

    Raises:
        InputError, FileError: An object without states, or a file that cannot be read.
    """

    def __init__(self, config: HeavyConfig):
        self._config, self._robot = config, load_robot()
        stored = load_handoffs(config.handoffs, robot=self._robot)
        self._names, without = eligible(config.objects, stored)
        if without:
            raise InputError("--objects", without, f"some of {', '.join(stored.object_names)}")
        self._states = states_of(stored, self._names, "all")
        self._world = functools.cache(self._made)

    def rows(self, job: tuple[float, float]) -> list[dict[str, Any]]:
        """A row per object, of one factor on the torque limits and one force."""
        torque, most = job
        config, world = self._config, self._world(torque)
        chosen = EvaluateConfig(
            out=config.out,
            controller="grip",
            grip=replace(REACTING, most=most),
            episodes=config.episodes,
            seed=config.seed,
        )
        quiet, reached = Console(quiet=True), self._states.reached
        found, _ = evaluate(world, self._names, chosen, None, reached, quiet)
        mass = {obj.name: obj.mass for obj in world.scene.objects}
        asked = {"most_n": most, "finger_torque": torque}
        return [asked | {"mass_kg": mass[row.object]} | to_record(row) for row in found]

    def _made(self, torque: float) -> World:
        """The world in which fingers are so strong."""
        config, settings = self._config, SceneConfig(finger_torque=torque)
        scene = build_scene_of(config.objects, config.objects_dir, self._robot, settings)
        return build_world(scene, self._states, TaskConfig().control_dt)


def main(config: HeavyConfig) -> None:
    """Evaluates, and writes the file."""
    check_writable("--out", config.out)
    console, made, own = Console(stderr=True), provenance(config.seed), Grips(config)
    identity = {
        "schema": SCHEMA,
        "settings": to_record(unspread(config)),
        "sha256": file_digests(handoffs=config.handoffs),
    }
    jobs = [
        (f"torque {torque}, most {most}", (torque, most))
        for torque in config.finger_torque
        for most in config.most
    ]
    setup = (lambda: own) if config.alone else functools.partial(Grips, config)
    journal = Journal(config.out, identity, made["git"])
    rows = []
    with counting_progress(console) as bar:
        job = bar.add_task("grips", total=len(jobs))
        for found in journaled(config, Grips.rows, jobs, setup, journal):
            rows += found
            bar.update(job, advance=1)
    write_json(config.out, identity | {"provenance": made, "rows": rows})
    journal.close()
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    import heavy_objects as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.HeavyConfig, description=__doc__)))
