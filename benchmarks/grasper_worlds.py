"""How fast many whole grasps run at once: controllers and physics of all worlds.

Every world selects, plans, reaches, closes, lifts and holds. One compiled function makes plans for
a batch of worlds, another advances all worlds by half a second. Physics alone is timed from the
state of the middle of the run, with the joint targets held. Compilation is timed apart.

  python benchmarks/grasper_worlds.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Int
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.config import ClosingController
from mjx_grasp.evaluation.grasps.plans import Wanted, planned, planned_in_parts, with_plans
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.trials import GraspProblem, stacked
from mjx_grasp.geometry import so3
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.known import known_objects
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Tried, Ways
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import Count, Positive, Seed, Suffix
from mjx_grasp.robot.interface import Measured
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.engines import Engine, make_physics
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.physics import Physics, Truth, WorldParams, make_params
from mjx_grasp.sim.scene import SceneConfig, build_scene
from mjx_grasp.tasks.config import SuccessConfig

_SEGMENT_S, _REPEATS = 0.5, 3


@dataclass(frozen=True, kw_only=True)
class WorldsBenchmarkConfig(ObjectsConfig):
    """What to measure."""

    out: Annotated[Path, Suffix((".json",))]
    """results file"""
    objects: tuple[str, ...] = ("eight",)
    worlds: Count = 4096
    """shared evenly among the objects"""
    seconds: Positive = 9.0
    """of every grasp [s]"""
    physics_dt: Positive = SceneConfig().physics_dt
    """physics step [s]"""
    solver_iterations: Count = SceneConfig().solver_iterations
    """most Newton iterations of a physics step [-]"""
    engine: Engine = "mjx"
    controller: ClosingController = "policy"
    """what closes: the shipped policy on top of a grip that answers to load, or that grip alone"""
    plan_batch: Count = 128
    """worlds that are planned for at once"""
    seed: Seed = 0
    """of the poses"""


class Worlds(NamedTuple):
    """All worlds between two ticks."""

    physics: Any
    measured: Measured
    truth: Truth
    grasp: GraspState | None
    """None before they begin"""
    due: Array
    """which of them want new plans"""
    overflown: Array
    """whose buffers of contacts or constraints were ever too small"""


def main(config: WorldsBenchmarkConfig) -> None:
    """Grasps, times, writes."""
    check_writable("--out", config.out)
    if config.seconds < _SEGMENT_S:
        raise InputError("--seconds", config.seconds, f"at least {_SEGMENT_S:g}")
    made, robot, console = provenance(config.seed), load_robot(), Console(stderr=True)
    grasper = loaded_grasper(robot, closing_policy(config.controller, None, robot))
    objects = list(load_objects(config.objects, config.objects_dir, weight=config.weight))
    if config.worlds % len(objects):
        raise InputError("--worlds", config.worlds, f"a multiple of the {len(objects)} objects")
    settings = SceneConfig(physics_dt=config.physics_dt, solver_iterations=config.solver_iterations)
    scene = build_scene(objects, robot, settings)
    physics = make_physics(config.engine, scene, config.worlds, grasper.dt)
    problem = draw_problem(scene, config.worlds // len(objects), config.seed)
    of_each = stacked(known_objects(objects, robot))
    known = jax.tree.map(lambda leaf: leaf[problem.object_index], of_each)
    measurements = _run(config, grasper, physics, known, problem, console)
    record = {
        "schema": "mjx_grasp.grasper_worlds/1",
        "engine": config.engine,
        "worlds": config.worlds,
        "objects": [obj.name for obj in objects],
        "physics_dt": config.physics_dt,
        "solver_iterations": config.solver_iterations,
        "controller": config.controller,
        **measurements,
        "provenance": made,
    }
    write_json(config.out, record)
    console.print({k: v for k, v in record.items() if k not in ("provenance", "phases")})


def _run(
    config: WorldsBenchmarkConfig,
    grasper: Grasper,
    physics: Physics,
    known: Known,
    problem: GraspProblem,
    console: Console,
) -> dict[str, Any]:
    """What it takes, and what comes of it."""
    library = start_library(grasper.reacher.body, grasper.planner.config)

    def plans(worlds: Worlds, key: Array, rows: Int[np.ndarray, " k"]) -> Ways | None:
        return planned(grasper, library, wanted(worlds, known, key), rows, config.plan_batch)

    anew = partial(planned_anew, grasper, library, known, config.plan_batch)
    params = make_params(jnp.asarray(problem.object_index), physics.scene.config.friction[0])
    key, everyone = jax.random.key(config.seed), np.arange(config.worlds)
    worlds = at_home(grasper, physics, problem)
    _, first_s = timed(plans, worlds, key, everyone[: config.plan_batch])
    ways, plan_s = timed(plans, worlds, key, everyone)
    grasp = jax.jit(jax.vmap(grasper.start))(worlds.measured, known, seen_of(worlds.truth), ways)
    worlds = worlds._replace(grasp=grasp)
    started = time.perf_counter()
    advance = jax.jit(partial(segment, grasper, physics)).lower(worlds, params, known).compile()
    jax.block_until_ready(advance(worlds, params, known))  # Warp makes its arrays and graph
    jax.block_until_ready(anew(worlds, key, everyone[:1]))
    compile_s = time.perf_counter() - started

    tick_s, phases, replans, replan_s, middle = [], [], 0, 0.0, worlds
    count = round(config.seconds / _SEGMENT_S)
    with counting_progress(console) as bar:
        for number in bar.track(range(count), description="half seconds"):
            worlds, seconds = timed(advance, worlds, params, known)
            tick_s.append(seconds)
            phases.append(np.bincount(np.asarray(worlds.grasp.phase), minlength=len(Phase)))
            middle = worlds if number == count // 2 else middle
            due = np.flatnonzero(worlds.due)
            if len(due):
                key = jax.random.fold_in(key, number)
                worlds, seconds = timed(anew, worlds, key, due)
                replans, replan_s = replans + len(due), replan_s + seconds
    alone = jax.jit(partial(physics_alone, physics)).lower(middle, params).compile()
    physics_s = median(timed(alone, middle, params)[1] for _ in range(_REPEATS))

    rise = np.asarray(worlds.truth.object_pos[:, 2]) - problem.p_wo[:, 2]
    simulated, ticks_s = count * _SEGMENT_S, sum(tick_s)
    names = [phase.name.lower() for phase in Phase]
    return {
        "simulated_s": simulated,
        "segment_s": _SEGMENT_S,
        "segments_s": tick_s,
        "plan_batch": config.plan_batch,
        "plan_s": plan_s,
        "replans": replans,
        "replan_s": replan_s,
        "physics_segment_s": physics_s,
        "compile_s": {"plans, and the first batch": first_s, "ticks": compile_s},
        "times_real_time": {
            "physics": _SEGMENT_S / physics_s,
            "ticks": simulated / ticks_s,
            "with plans": simulated / (ticks_s + plan_s + replan_s),
        },
        "lifted_percent": 100.0 * float(np.mean(rise >= SuccessConfig().height)),
        "overflow_percent": 100.0 * float(np.mean(np.asarray(worlds.overflown))),
        "phases": [dict(zip(names, map(int, row), strict=True)) for row in phases],
    }


def at_home(grasper: Grasper, physics: Physics, problem: GraspProblem) -> Worlds:
    """All robots at home, all objects where they lie, no grasp begun."""
    at, worlds = physics.scene.addresses, len(problem.object_index)
    home = np.asarray(grasper.reacher.body.home, np.float32)
    qpos = np.zeros((worlds, physics.scene.model.nq), np.float32)
    qpos[:, at.robot_qpos] = home
    qpos[:, at.object_qpos] = np.concatenate([problem.p_wo, problem.quat], axis=1)
    ctrl = jnp.broadcast_to(jnp.asarray(home[np.argsort(at.robot_ctrl)]), (worlds, len(home)))
    measured, truth = at_rest(physics.scene, qpos, physics.substeps)
    state = jax.jit(physics.init)(jnp.asarray(qpos), ctrl)
    none = jnp.zeros(worlds, bool)
    return Worlds(state, measured, truth, None, none, none)


def wanted(worlds: Worlds, known: Known, key: Array) -> Wanted:
    """What is planned for: where everything is, and what has been tried."""
    q = worlds.measured.q
    tried = Tried.nothing(len(q)) if worlds.grasp is None else worlds.grasp.tried
    keys = jax.random.split(key, len(q))
    return Wanted(known, seen_of(worlds.truth), q, tried, keys)


def planned_anew(
    grasper: Grasper,
    library: Library,
    known: Known,
    batch: int,
    worlds: Worlds,
    key: Array,
    due: Int[np.ndarray, " k"],
) -> Worlds:
    """New plans for the worlds that want some."""
    grasp = worlds.grasp
    asked = wanted(worlds, known, key)
    for rows, ways in planned_in_parts(grasper, library, asked, due, batch):
        grasp = with_plans(grasper, grasp, ways, rows)
    return worlds._replace(grasp=grasp, due=jnp.zeros_like(worlds.due))


def segment(
    grasper: Grasper, physics: Physics, worlds: Worlds, params: WorldParams, known: Known
) -> Worlds:
    """Some ticks of all worlds."""
    order = np.argsort(physics.scene.addresses.robot_ctrl)

    def tick(worlds: Worlds, _: None) -> tuple[Worlds, None]:
        seen = seen_of(worlds.truth)
        grasp, done = grasper.ticks(worlds.grasp, worlds.measured, known, seen)
        stepped = physics.step(worlds.physics, params, done.target[:, order])
        due, overflown = worlds.due | done.plans_due, worlds.overflown | stepped[2].overflow
        return Worlds(*stepped, grasp, due, overflown), None

    return jax.lax.scan(tick, worlds, length=round(_SEGMENT_S / grasper.dt))[0]


def physics_alone(physics: Physics, worlds: Worlds, params: WorldParams) -> Array:
    """The same time with the joint targets held, without controllers."""
    target = worlds.grasp.target[:, np.argsort(physics.scene.addresses.robot_ctrl)]

    def tick(state: Any, _: None) -> tuple[Any, None]:
        return physics.step(state, params, target)[0], None

    ticks = round(_SEGMENT_S / (physics.substeps * physics.scene.config.physics_dt))
    final, _ = jax.lax.scan(tick, worlds.physics, length=ticks)
    return final.qpos


def seen_of(truth: Truth) -> Seen:
    """A perfect tracker, with touch flags, of all worlds."""
    R_wo = so3.quat_to_mat(truth.object_quat)
    return Seen(truth.object_pos, R_wo, truth.tip_found, jnp.zeros((len(R_wo), 0, 4)))


def timed(function: Any, *given: Any) -> tuple[Any, float]:
    """What it gives, and how long that took [s]."""
    started = time.perf_counter()
    answer = jax.block_until_ready(function(*given))
    return answer, time.perf_counter() - started


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(WorldsBenchmarkConfig, description=__doc__)), keeps=False)
