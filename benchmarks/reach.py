"""Control ticks and whole reaches per second of the reaching controller.

Ticks of the published and of the default controller, for one robot and for thousands of worlds,
compilation apart; planning; and, where mink and daqp are installed, the reaches of mink's
differential inverse kinematics on the same cylinders towards the same standoff targets: tip
position tasks with its configuration and velocity limits and its collision avoidance of the hand
against object and table, one robot on one core.

  python benchmarks/reach.py --out FILE.json
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from mjx_grasp.atomic import write_json
from mjx_grasp.cli import run_command
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.provenance import provenance
from mjx_grasp.reaching.body import FINGERS, reach_body
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.reaching.poses import CylinderPoses, draw_poses
from mjx_grasp.reaching.presets import for_sweep, preset
from mjx_grasp.reaching.sweep import candidates_of, plan_all
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.selection import select, start_selection

_TABLE = ((0.35, 0.0, -0.02), (0.65, 0.70, 0.02))


@dataclass(frozen=True)
class ReachBenchmarkConfig:
    """What to measure."""

    out: Path
    """results file to write (.json)"""
    worlds: tuple[int, ...] = (1, 256, 4096)
    """robots at once [-]"""
    ticks: int = 50
    """of a timed run [-]"""
    repeats: int = 5
    mink_reaches: int = 16
    """reaches by mink; 0 leaves it out [-]"""
    seed: int = 12


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


def standoff_goals(reacher: Reacher, poses: CylinderPoses, k: int) -> np.ndarray:
    """Where the selection sends the tips at the start of a reach, [m]."""
    shape = Cylinder(jnp.float32(poses.radius[k]), jnp.float32(poses.half_length[k]))
    candidates = candidates_of(reacher, shape)
    hand = reacher.hand(reacher.body.kinematics.motion(jnp.asarray(reacher.body.home)))
    p_wo, R_wo = jnp.asarray(poses.p_wo[k]), jnp.asarray(poses.R_wo[k])
    state = start_selection(candidates, hand, R_wo)
    targets, _ = select(candidates, state, hand, p_wo, R_wo, reacher.selection)
    return np.asarray(reacher.standoffs(targets))


def mink_row(reacher: Reacher, poses: CylinderPoses, count: int) -> dict[str, Any] | None:
    """Reaches by mink with daqp, one robot; None where they are not installed."""
    if not (find_spec("daqp") and find_spec("mink")):
        return None
    import mink

    robot, dt = reacher.body.robot, reacher.config.controller.dt
    ticks, converged, seconds = 0, 0, 0.0
    tolerance, longest = 0.02, 300
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
        goals = standoff_goals(reacher, poses, k)
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
        for _ in range(longest):
            try:
                v = mink.solve_ik(configuration, [*tasks, posture], dt, "daqp", limits=limits)
            except mink.NoSolutionFound:
                v = np.zeros(model.nv)
            configuration.integrate_inplace(v, dt)
            ticks += 1
            tips = [configuration.data.site(f.tip_site).xpos for f in robot.hand.fingers]
            if np.linalg.norm(np.array(tips) - goals, axis=1).max() < tolerance:
                converged += 1
                break
        seconds += time.perf_counter() - start
    return {
        "controller": "mink with daqp, one robot on one core",
        "versions": {"mink": version("mink"), "daqp": version("daqp")},
        "reaches": count,
        "converged_20mm_3s_percent": 100.0 * converged / count,
        "ms_per_tick": 1e3 * seconds / ticks,
        "reaches_per_s": count / seconds,
    }


def own_reaches(reacher: Reacher, poses: CylinderPoses, plans, name: str) -> dict[str, Any]:
    """Reaches of the same length by this package, all at once: 3 s of control each."""
    row = tick_row(reacher, poses, plans, name, ReachBenchmarkConfig(Path(), ticks=300, repeats=1))
    row["reaches_per_s"] = row["robot_ticks_per_s"] / 300
    return row


def main(config: ReachBenchmarkConfig) -> None:
    """Measures, prints each row, writes the file."""
    body = reach_body(load_robot())
    most = max(config.worlds)
    poses = draw_poses(most, config.seed)
    rows: list[dict[str, Any]] = []
    for name in ("paper", "default"):
        settings = for_sweep(preset(name))
        reacher = Reacher(body, settings.reach, settings.selection)
        plans = None
        if settings.plan:
            few = min(most, 32)
            library = start_library(body, settings.plan)
            some = jax.tree.map(lambda leaf, few=few: leaf[:few], poses)
            plan_all(reacher, settings.plan, library, some, few)
            start = time.perf_counter()
            found = plan_all(reacher, settings.plan, library, some, few)
            rows.append({"planning_ms_per_pose": 1e3 * (time.perf_counter() - start) / few})
            # Repeated: what a tick takes does not depend on the plan.
            plans = jax.tree.map(lambda leaf: jnp.asarray(np.resize(leaf, (most, *leaf.shape[1:]))),
                                 found.plans)  # fmt: skip
        for worlds in config.worlds:
            some = jax.tree.map(lambda leaf, n=worlds: leaf[:n], poses)
            part = jax.tree.map(lambda leaf, n=worlds: leaf[:n], plans)
            rows.append(tick_row(reacher, some, part, name, config))
            print(json.dumps(rows[-1]), flush=True)
    paper = for_sweep(preset("paper"))
    reacher = Reacher(body, paper.reach, paper.selection)
    few = jax.tree.map(lambda leaf: leaf[: max(config.mink_reaches, 1)], poses)
    rows.append(own_reaches(reacher, few, None, "paper, reaches of 3 s"))
    other = mink_row(reacher, poses, config.mink_reaches) if config.mink_reaches else None
    if other:
        rows.append(other)
        print(json.dumps(other))
    write_json(
        config.out, {"provenance": provenance(config.seed), "fingers": FINGERS, "rows": rows}
    )


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReachBenchmarkConfig, description=__doc__)))
