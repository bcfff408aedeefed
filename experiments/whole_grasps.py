"""Whole grasps from home of the eight, closed loop in native MuJoCo.

python experiments/whole_grasps.py --objects-dir SCANS --out experiments/results/grasps.json
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.evaluation.grasps.problems import draw_problem, known_of
from mjx_grasp.evaluation.grasps.results import as_record, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.run import loaded_grasper
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline.assemble import known_object
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import Count, Seed, Suffix, to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene

SCHEMA = "mjx_grasp.grasps/1"


@dataclass(frozen=True, kw_only=True)
class GraspsConfig(ObjectsConfig):
    """What is grasped, how often, by what."""

    trials: Count = 8
    """of each object [-]"""
    seed: Seed = 0
    """of the poses and plans"""
    policy: Path | None = None
    """what corrects the closing; by default the grip alone closes"""
    told: bool = True
    """whether fingertips tell what they touch; else the momentum observer alone does"""
    out: Annotated[Path, Suffix((".json",))] = Path("experiments/results/grasps.json")
    """results file (.json)"""


def main(config: GraspsConfig) -> None:
    """Runs, sums, writes."""
    check_writable("--out", config.out)
    made, console, robot = provenance(config.seed), Console(stderr=True), load_robot()
    grasper = loaded_grasper(robot, config.policy)
    objects = list(load_objects(config.objects, config.objects_dir, weight=config.weight))
    library = start_library(grasper.reacher.body, grasper.planner.config)
    problem = draw_problem(objects, config.trials, config.seed)
    known = known_of([known_object(obj, robot) for obj in objects], problem)
    physics = NativePhysics(build_scene(objects, robot), grasper.dt)
    started = time.perf_counter()
    with counting_progress(console) as bar:
        job = bar.add_task("grasps", total=100)
        end, trace = grasp_all(
            grasper, library, physics, known, problem, config.seed, config.told,
            lambda share: bar.update(job, completed=round(100 * share)),
        )  # fmt: skip
    rows = grasp_rows([obj.name for obj in objects], problem, end, trace, grasper.dt)
    record = as_record(rows)
    seconds = round(time.perf_counter() - started, 1)
    settings = {"config": to_record(config), "seconds": seconds, "ticks": len(trace.phase)}
    write_json(config.out, {"schema": SCHEMA, **settings, **record, "provenance": made})
    for name, sums in {**record["objects"], "all": record["all"]}.items():
        console.print(name, sums)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(GraspsConfig, description=__doc__)))
