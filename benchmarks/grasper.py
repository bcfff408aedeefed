"""How long one control tick of the `Grasper`, and one search for plans, take in one world.

Whole grasps from home in native MuJoCo, one after the other, on one core. A tick is timed from
what is measured, in NumPy's arrays as a driver supplies them, to the joint targets, by the phase
that it is in; physics and compilation apart. Between ticks the state is one vector.

Each grasp's ticks are timed twice: in the loop, where physics on the same core leaves them cold
caches, and again from the record, one after the other, the least that they take; a robot's computer
is between the two. The second time has to give the same.

  python benchmarks/grasper.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import MjxGraspError
from mjx_grasp.evaluation.grasps.config import ClosingController
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.geometry import so3
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline.flat import FlatTick
from mjx_grasp.pipeline.known import known_objects
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import Seen
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import Count, Seed, Suffix
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics, at_rest
from mjx_grasp.sim.physics import make_params
from mjx_grasp.sim.scene import build_scene

_LONGEST_S, _HOLD_S = 12.0, 1.0
_MS = 1e3


@dataclass(frozen=True, kw_only=True)
class GrasperBenchmarkConfig(ObjectsConfig):
    """What to measure."""

    out: Annotated[Path, Suffix((".json",))]
    """results file"""
    grasps: Count = 2
    """of each object [-]"""
    controller: ClosingController = "policy"
    """what closes: a policy on top of a grip that answers to load, or that grip alone"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    seed: Seed = 0
    """of the poses"""


def main(config: GrasperBenchmarkConfig) -> None:
    """Grasps, times, writes."""
    check_writable("--out", config.out)
    if hasattr(os, "sched_setaffinity"):  # not on macOS
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX makes its threads
    made, robot, console = provenance(config.seed), load_robot(), Console(stderr=True)
    grasper = loaded_grasper(robot, closing_policy(config.controller, config.policy, robot))
    objects = list(load_objects(config.objects, config.objects_dir, weight=config.weight))
    library = start_library(grasper.reacher.body, grasper.planner.config)
    physics = NativePhysics(build_scene(objects, robot), grasper.dt, threads=1)
    known = known_objects(objects, robot)
    problem = draw_problem(physics.scene, config.grasps, config.seed)
    at = physics.scene.addresses
    order, home = np.argsort(at.robot_ctrl), np.asarray(robot.home, np.float32)
    plan = jax.jit(lambda *given: grasper.plan(library, *given))
    start, adopt, step = jax.jit(grasper.start), jax.jit(grasper.adopt), jax.jit(physics.step)
    ticks, alone, plans = defaultdict(list), defaultdict(list), []

    def timed(kept: list[float], function: Any, *given: Any) -> Any:
        started = time.perf_counter()
        answer = jax.block_until_ready(function(*given))
        kept.append(_MS * (time.perf_counter() - started))
        return answer

    with counting_progress(console) as bar:
        for w in bar.track(range(len(problem.object_index)), description="grasps"):
            k = int(problem.object_index[w])
            qpos = np.zeros((1, physics.scene.model.nq), np.float32)
            qpos[:, at.robot_qpos] = home
            qpos[:, at.object_qpos] = np.concatenate([problem.p_wo[w], problem.quat[w]])
            measured, truth = at_rest(physics.scene, qpos, physics.substeps)
            world = physics.init(jnp.asarray(qpos), jnp.asarray(home[order])[None])
            params = make_params(jnp.array([k]), physics.scene.config.friction[0])
            now, seen = jax.device_get((one(measured), seen_of(truth)))
            key = jax.random.key(w)
            ways = timed(plans, plan, known[k], seen, now.q, key)
            state = start(now, known[k], seen, ways)
            if w == 0:  # a search that avoids a place is another program
                jax.block_until_ready(plan(known[k], seen, now.q, key, state.tried))
                tick = FlatTick(grasper, state)
            vector, record = tick.flat(state), []
            for _ in range(round(_LONGEST_S / grasper.dt)):
                phase = Phase(int(state.phase))
                given = vector, now, known[k], seen
                vector, done = timed(ticks[phase], tick, *given)
                record.append((phase, given, vector))
                state = tick.state(vector)
                world, measured, truth = step(world, params, done.target[None, order])
                now, seen = jax.device_get((one(measured), seen_of(truth)))
                if bool(done.plans_due):
                    found = timed(plans, plan, known[k], seen, now.q, key, state.tried)
                    state = adopt(state, found)
                    vector = tick.flat(state)
                held = float(state.clock - state.entered[Phase.HOLDING])
                if state.phase == Phase.FAILED or held >= _HOLD_S:
                    break
            for phase, given, vector in record:
                again, _ = timed(alone[phase], tick, *given)
                if not np.array_equal(again, vector, equal_nan=True):
                    raise MjxGraspError(f"a tick of {phase.name} is another when it is repeated")
    result = {
        "controller": config.controller,
        "tick_ms": by_phase(ticks),
        "tick_alone_ms": by_phase(alone),
        "plan_ms": summed(plans[1:]),
    }
    write_json(config.out, {"schema": "mjx_grasp.grasper/1", **result, "provenance": made})
    console.print(result)


def one(batched: Any) -> Any:
    """The only world of a batch."""
    return jax.tree.map(lambda leaf: leaf[0], batched)


def seen_of(truth: Any) -> Seen:
    """A perfect tracker, with touch flags."""
    R_wo = so3.quat_to_mat(truth.object_quat[0])
    return Seen(truth.object_pos[0], R_wo, truth.tip_found[0], jnp.zeros((0, 4)))


def by_phase(ticks: dict[Phase, list[float]]) -> dict[str, dict[str, float]]:
    """Of each phase and of all ticks, but for the first of each, which warms up."""
    every = [t for times in ticks.values() for t in times[1:]]
    found = {phase.name.lower(): summed(times[1:]) for phase, times in ticks.items()}
    return found | {"all": summed(every)}


def summed(times: list[float]) -> dict[str, float]:
    """Median and upper percentiles [ms]."""
    p50, p99 = np.percentile(times, (50, 99)) if times else (np.nan, np.nan)
    return {"count": len(times), "p50": round(float(p50), 3), "p99": round(float(p99), 3)}


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(GrasperBenchmarkConfig, description=__doc__)), keeps=False)
