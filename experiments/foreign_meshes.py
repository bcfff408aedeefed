"""Ten meshes that no catalogue has: each is grasped, or refused with what to do.

They are made with trimesh, some of them with the faults that meshes come with: too large, in
millimetres, open, several bodies, hardly any triangles. Those that load and have a candidate are
grasped in native MuJoCo from home, once each.

  python experiments/foreign_meshes.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from rich.console import Console
from trimesh import Trimesh, creation

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.evaluation.grasps.results import grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.run import loaded_grasper
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.pipeline.known import check_graspable, known_object
from mjx_grasp.pipeline.state import Known
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Seed, to_record
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene

SCHEMA = "mjx_grasp.foreign_meshes/1"


def _lamp() -> Trimesh:
    profile = np.array([[0, 0], [0.045, 0], [0.04, 0.012], [0.018, 0.03], [0.022, 0.1], [0, 0.11]])
    return creation.revolve(profile, sections=48)


def _bracket() -> Trimesh:
    upright = creation.box((0.02, 0.06, 0.1)).apply_translation((0.0, 0.0, 0.05))
    foot = creation.box((0.08, 0.06, 0.02)).apply_translation((0.03, 0.0, 0.01))
    return trimesh.util.concatenate([upright, foot])


def _shell() -> Trimesh:
    whole = creation.cylinder(radius=0.035, height=0.09, sections=48)
    return whole.submesh([np.flatnonzero(whole.face_normals[:, 2] < 0.9)], append=True)


MESHES: dict[str, Callable[[], Trimesh]] = {
    "capsule": lambda: creation.capsule(height=0.08, radius=0.025),
    "cone": lambda: creation.cone(radius=0.04, height=0.12, sections=48),
    "prism": lambda: creation.cylinder(radius=0.03, height=0.12, sections=6),
    "ball": lambda: creation.icosphere(subdivisions=3, radius=0.035),
    "ring": lambda: creation.torus(major_radius=0.045, minor_radius=0.014),
    "lamp foot": _lamp,
    "bracket of two bodies": _bracket,
    "open shell": _shell,
    "crate": lambda: creation.box((0.5, 0.4, 0.3)),
    "box in millimetres": lambda: creation.box((60.0, 40.0, 90.0)),
}


@dataclass(frozen=True)
class ForeignConfig(CommandSettings):
    """Where the results go."""

    out: Path = Path("experiments/results/foreign_meshes.json")
    seed: Seed = 0


def loaded(path: Path, robot: RobotSpec) -> tuple[ObjectModel, Known] | str:
    """A mesh as an object with its candidates, or why it is refused."""
    try:
        (obj,) = load_objects([str(path)])
        known = known_object(obj, robot)
        check_graspable(obj.name, float(known.candidates.score.max()), robot.hand)
    except (FileError, InputError) as error:
        return str(error).replace(str(path), path.name)
    return obj, known


def main(config: ForeignConfig) -> None:
    """Loads, grasps, writes."""
    check_writable("--out", config.out)
    made, robot, console = provenance(config.seed), load_robot(), Console(stderr=True)
    rows: dict[str, dict[str, Any]] = {}
    objects: list[ObjectModel] = []
    known: list[Known] = []
    with tempfile.TemporaryDirectory() as folder, counting_progress(console) as bar:
        for name, make in bar.track(MESHES.items(), description="meshes"):
            path = Path(folder) / f"{name.replace(' ', '_')}.stl"
            make().export(path)
            found = loaded(path, robot)
            if isinstance(found, str):
                rows[name] = {"refused": found}
            else:
                rows[name] = {"refused": None}
                objects.append(found[0])
                known.append(found[1])
        grasper = loaded_grasper(robot)
        assert grasper.planner is not None
        library = start_library(grasper.reacher.body, grasper.planner.config)
        physics = NativePhysics(build_scene(objects, robot), grasper.dt)
        problem = draw_problem(physics.scene, 1, config.seed)
        job = bar.add_task("grasps", total=1.0)
        end, trace = grasp_all(
            grasper, library, physics, known, problem,
            progress=lambda share: bar.update(job, completed=share),
        )  # fmt: skip
    ends = grasp_rows([obj.name for obj in objects], problem, end, trace, grasper.dt)
    accepted = [name for name, row in rows.items() if row["refused"] is None]
    for name, row in zip(accepted, ends, strict=True):
        rows[name] |= {
            "outcome": row.outcome,
            "lifted_s": row.lifted_s,
            "force_mean_n": row.force_mean_n,
        }
    content = {"schema": SCHEMA, "config": to_record(config), "meshes": rows, "provenance": made}
    write_json(config.out, content)
    Console().print(rows)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ForeignConfig, description=__doc__)))
