"""What it takes to lift the heaviest objects: harder grips, and stronger fingers.

The grip that answers to load, up to several forces, on fingers whose torque limits are those of the
robot or a multiple of them. States are those of `experiments/paper.py objects`.

  python experiments/heavy_objects.py --objects-dir SCANS
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

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
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed, to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, build_scene_of, build_world

SCHEMA = "mjx_grasp.heavy/1"


@dataclass(frozen=True)
class HeavyConfig(CommandSettings):
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


def main(config: HeavyConfig) -> None:
    """Evaluates, and writes the file."""
    check_writable("--out", config.out)
    console, robot, rows = Console(stderr=True), load_robot(), []
    made, stored = provenance(config.seed), load_handoffs(config.handoffs, robot=robot)
    names, without = eligible(config.objects, stored)
    if without:
        raise InputError("--objects", without, f"some of {', '.join(stored.object_names)}")
    states, quiet = states_of(stored, names, "all"), Console(quiet=True)
    with counting_progress(console) as bar:
        job = bar.add_task("grips", total=len(config.most) * len(config.finger_torque))
        for torque in config.finger_torque:
            settings = SceneConfig(finger_torque=torque)
            scene = build_scene_of(config.objects, config.objects_dir, robot, settings)
            world = build_world(scene, states, TaskConfig().control_dt)
            mass = {obj.name: obj.mass for obj in scene.objects}
            for most in config.most:
                chosen = EvaluateConfig(
                    out=config.out,
                    controller="grip",
                    grip=replace(REACTING, most=most),
                    episodes=config.episodes,
                    seed=config.seed,
                )
                found, _ = evaluate(world, names, chosen, None, states.reached, quiet)
                rows += [
                    {"most_n": most, "finger_torque": torque, "mass_kg": mass[row.object]}
                    | to_record(row)
                    for row in found
                ]
                bar.update(job, advance=1)
    write_json(
        config.out,
        {
            "schema": SCHEMA,
            "settings": to_record(config),
            "sha256": file_digests(handoffs=config.handoffs),
            "provenance": made,
            "rows": rows,
        },
    )
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(HeavyConfig, description=__doc__)))
