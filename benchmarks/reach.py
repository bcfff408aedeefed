"""Control ticks and whole reaches per second of the reaching controller.

Ticks of the published and of the default controller, for one robot and for thousands of worlds,
compilation apart; reaches one after another until every tip is within 20 mm; and, where
mink and daqp are installed, the same by mink's differential inverse kinematics on the same
cylinders towards the standoff targets of either controller at the start: tip position tasks with
its configuration and velocity limits and its collision avoidance of the hand against object and
table. The default's plans are made one after another too, and their time is given apart.

On one core of a processor:

  taskset -c 0 python benchmarks/reach.py --out FILE.json
"""

from __future__ import annotations

import json
import os
import statistics
import time
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.reach.poses import CylinderPoses, draw_poses
from mjx_grasp.evaluation.reach.sweep import candidates_of, plan_keys
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.select import select
from mjx_grasp.grasp.targets import standoffs
from mjx_grasp.posture.body import FINGERS, robot_body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import ReachPreset, for_sweep, reach_preset
from mjx_grasp.reaching.state import Plans
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Range, Seed, Several
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot

_TABLE = ((0.35, 0.0, -0.02), (0.65, 0.70, 0.02))
_TOLERANCE = 0.020
"""a reach has converged when every tip is this near [m]"""


@dataclass(frozen=True)
class ReachBenchmarkConfig(CommandSettings):
    """What to measure."""

    out: Path
    """results file to write (.json)"""
    worlds: Annotated[tuple[Count, ...], Several()] = (1, 256)
    """robots at once [-]"""
    ticks: Count = 50
    """of a timed run [-]"""
    repeats: Count = 5
    reaches: Annotated[int, Range(2, 2**31 - 1)] = 32
    """cylinders reached for one after another, by this package and by mink [-]"""
    longest_s: Annotated[tuple[Positive, ...], Several()] = (3.0, 7.0)
    """after which a reach that has not converged is given up, one after the other [s]"""
    seed: Seed = 12


def tick_row(reacher: Reacher, poses: CylinderPoses, plans, name: str, config) -> dict[str, Any]:
    """Time of a control tick of all worlds together."""
    count = len(poses.radius)
    home = jnp.asarray(reacher.body.home)

    def world(shape, p_wo, R_wo, plans):
        candidates = candidates_of(reacher, shape)
        state = reacher.start(home, candidates, p_wo, R_wo, plans)

        def tick(carry, _):
            state, q = carry
            state, done = reacher.tick(
                state, q, shape, candidates, p_wo, R_wo, jnp.zeros((0, 4)), plans
            )
            return (state, q + reacher.config.controller.dt * done.velocity), None

        return jax.lax.scan(tick, (state, home), length=config.ticks)[0][1]

    shape = Cylinder(jnp.asarray(poses.radius), jnp.asarray(poses.half_length))
    arguments = (shape, jnp.asarray(poses.p_wo), jnp.asarray(poses.R_wo), plans)
    start = time.perf_counter()
    run = jax.jit(jax.vmap(world)).lower(*arguments).compile()
    compiled = time.perf_counter() - start
    jax.block_until_ready(run(*arguments))
    times = []
    for _ in range(config.repeats):
        start = time.perf_counter()
        jax.block_until_ready(run(*arguments))
        times.append(time.perf_counter() - start)
    seconds = statistics.median(times) / config.ticks
    return {
        "controller": name,
        "worlds": count,
        "ms_per_tick": 1e3 * seconds,
        "robot_ticks_per_s": count / seconds,
        "compile_s": compiled,
    }


def standoff_goals(
    reacher: Reacher, poses: CylinderPoses, plans: Plans | None, k: int
) -> np.ndarray:
    """Where the selection sends the tips at the start of a reach, [m]."""
    shape = Cylinder(jnp.float32(poses.radius[k]), jnp.float32(poses.half_length[k]))
    candidates = candidates_of(reacher, shape)
    home = jnp.asarray(reacher.body.home)
    hand = reacher.hand(reacher.body.kinematics.motion(home))
    p_wo, R_wo = jnp.asarray(poses.p_wo[k]), jnp.asarray(poses.R_wo[k])
    plan = jax.tree.map(lambda leaf: jnp.asarray(leaf[k]), plans)
    state = reacher.start(home, candidates, p_wo, R_wo, plan).selection
    targets, _ = select(candidates, state, hand, p_wo, R_wo, reacher.selection)
    return np.asarray(standoffs(targets.position, targets.normal, reacher.selection.targets))


def mink_row(
    reacher: Reacher, poses: CylinderPoses, plans: Plans | None, longest_s: float, name: str
) -> dict[str, Any] | None:
    """Reaches by mink with daqp, one robot; None where they are not installed."""
    if not (find_spec("daqp") and find_spec("mink")):
        return None
    import mink

    robot, dt = reacher.body.robot, reacher.config.controller.dt
    ticks, converged, seconds = 0, 0, 0.0
    count = len(poses.radius)
    for k in range(count):
        spec = robot_mjspec(robot)
        spec.worldbody.add_geom(
            name="table", type=mujoco.mjtGeom.mjGEOM_BOX, pos=_TABLE[0], size=_TABLE[1]
        )
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, poses.R_wo[k].astype(float).ravel())
        spec.worldbody.add_geom(
            name="object",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=poses.p_wo[k].astype(float).tolist(),
            quat=quat.tolist(),
            size=[float(poses.radius[k]), float(poses.half_length[k]), 0.0],
        )
        model = spec.compile()
        configuration = mink.Configuration(model)
        configuration.update(np.array(robot.home))
        goals = standoff_goals(reacher, poses, plans, k)
        tasks = []
        for finger, goal in zip(robot.hand.fingers, goals, strict=True):
            task = mink.FrameTask(finger.tip_site, "site", 1.0, 0.0, gain=0.05, lm_damping=1e-3)
            task.set_target(mink.SE3.from_translation(goal.astype(float)))
            tasks.append(task)
        posture = mink.PostureTask(model, cost=1e-2)
        posture.set_target(np.array(robot.home))
        hand = [
            model.geom(g).name
            for g in range(model.ngeom)
            if model.geom_contype[g] == 1 and model.geom(g).name
        ]
        limits = [
            mink.ConfigurationLimit(model),
            mink.VelocityLimit(
                model,
                dict(zip(robot.joints, map(np.atleast_1d, robot.velocity_limits), strict=True)),
            ),
            mink.CollisionAvoidanceLimit(
                model,
                [(hand, ["object", "table"])],
                minimum_distance_from_collisions=0.010,
                collision_detection_distance=0.05,
            ),
        ]
        start = time.perf_counter()
        for _ in range(round(longest_s / dt)):
            try:
                v = mink.solve_ik(configuration, [*tasks, posture], dt, "daqp", limits=limits)
            except mink.NoSolutionFound:
                v = np.zeros(model.nv)
            configuration.integrate_inplace(v, dt)
            ticks += 1
            tips = [configuration.data.site(f.tip_site).xpos for f in robot.hand.fingers]
            if np.linalg.norm(np.array(tips) - goals, axis=1).max() < _TOLERANCE:
                converged += 1
                break
        seconds += time.perf_counter() - start
    return {
        "controller": f"mink with daqp, targets of {name}, one robot",
        "versions": {"mink": version("mink"), "daqp": version("daqp")},
        "reaches": count,
        "longest_s": longest_s,
        "converged_percent": 100.0 * converged / count,
        "ms_per_tick": 1e3 * seconds / ticks,
        "reaches_per_s": count / seconds,
        "converged_reaches_per_s": converged / seconds,
    }


def own_reaches(
    reacher: Reacher,
    poses: CylinderPoses,
    plans: Plans | None,
    planning_s: float,
    longest_s: float,
    name: str,
) -> dict[str, Any]:
    """Reaches of the same cylinders by this package, one robot after another like mink's."""
    home, dt = jnp.asarray(reacher.body.home), reacher.config.controller.dt
    longest = round(longest_s / dt)

    @jax.jit
    def reach(shape, p_wo, R_wo, plans):
        candidates = candidates_of(reacher, shape)

        def goes_on(carry):
            return (carry[2] < longest) & (carry[3] >= _TOLERANCE)

        def tick(carry):
            state, q, ticks, _ = carry
            state, done = reacher.tick(
                state, q, shape, candidates, p_wo, R_wo, jnp.zeros((0, 4)), plans
            )
            q = q + dt * done.velocity
            error = jnp.where(done.targets.valid, jnp.max(done.report.error), jnp.inf)
            return state, q, ticks + 1, error

        state = reacher.start(home, candidates, p_wo, R_wo, plans)
        start = (state, home, jnp.int32(0), jnp.float32(jnp.inf))
        return jax.lax.while_loop(goes_on, tick, start)[2:]

    def problem(k):
        shape = Cylinder(poses.radius[k], poses.half_length[k])
        return shape, poses.p_wo[k], poses.R_wo[k], jax.tree.map(lambda leaf: leaf[k], plans)

    count = len(poses.radius)
    jax.block_until_ready(reach(*problem(0)))
    start = time.perf_counter()
    ends = [jax.block_until_ready(reach(*problem(k))) for k in range(count)]
    seconds = time.perf_counter() - start
    converged = sum(float(e) < _TOLERANCE for _, e in ends)
    return {
        "controller": f"{name}, one robot",
        "reaches": count,
        "longest_s": longest_s,
        "converged_percent": 100.0 * converged / count,
        "ms_per_tick": 1e3 * seconds / sum(int(n) for n, _ in ends),
        "ms_per_plan": 1e3 * planning_s / count,
        "reaches_per_s": count / seconds,
        "reaches_per_s_with_planning": count / (seconds + planning_s),
        "converged_reaches_per_s": converged / (seconds + planning_s),
    }


def plans_of(
    settings: ReachPreset, reacher: Reacher, poses: CylinderPoses, few: int
) -> tuple[Plans | None, float]:
    """Plans for a few of the poses, searched for one after another, and the seconds that took.

    They are repeated for all: what a tick takes does not depend on them.
    """
    if not settings.plan:
        return None, 0.0
    planner = Planner(reacher, settings.plan)
    library = start_library(reacher.body, settings.plan)
    home = jnp.asarray(reacher.body.home)

    @jax.jit
    def search(shape, p_wo, R_wo, key):
        around = Surroundings.still(shape, p_wo, R_wo)
        return planner.search(library, candidates_of(reacher, shape), around, home, key).plans

    keys = plan_keys(planner, few)
    given = [
        (Cylinder(poses.radius[k], poses.half_length[k]), poses.p_wo[k], poses.R_wo[k], keys[k])
        for k in range(few)
    ]
    jax.block_until_ready(search(*given[0]))
    start = time.perf_counter()
    found = [jax.block_until_ready(search(*each)) for each in given]
    seconds = time.perf_counter() - start
    count = len(poses.radius)
    plans = jax.tree.map(
        lambda *leaves: jnp.asarray(np.resize(np.stack(leaves), (count, *leaves[0].shape))), *found
    )
    return plans, seconds


def main(config: ReachBenchmarkConfig) -> None:
    """Measures, prints each row, writes the file after each."""
    check_writable("--out", config.out)
    body = robot_body(load_robot())
    most = max(*config.worlds, config.reaches)
    poses = draw_poses(most, config.seed)
    rows: list[dict[str, Any]] = []
    made = {
        "provenance": provenance(config.seed),
        "processor_cores": len(os.sched_getaffinity(0)),
        "fingers": FINGERS,
    }

    def done(row: dict[str, Any] | None) -> None:
        if row is None:
            return
        rows.append(row)
        print(json.dumps(row), flush=True)
        write_json(config.out, {**made, "rows": rows})

    few = jax.tree.map(lambda leaf: leaf[: config.reaches], poses)
    for name in ("paper", "default"):
        settings = for_sweep(reach_preset(name))
        reacher = Reacher(body, settings.reach, settings.selection)
        plans, planning_s = plans_of(settings, reacher, poses, config.reaches)
        for worlds in config.worlds:
            some, part = jax.tree.map(lambda leaf, n=worlds: leaf[:n], (poses, plans))
            done(tick_row(reacher, some, part, name, config))
        part = jax.tree.map(lambda leaf: leaf[: config.reaches], plans)
        for longest in config.longest_s:
            done(own_reaches(reacher, few, part, planning_s, longest, name))
            done(mink_row(reacher, few, part, longest, name))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReachBenchmarkConfig, description=__doc__)), keeps=False)
