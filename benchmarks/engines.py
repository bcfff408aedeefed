"""Control steps per second of the closing task in MJX and in native MuJoCo, on this device.

Both engines start from one state: drawn starts, `--warm-up` ticks on in native MuJoCo with zero
actions, so that the guided fingers have closed on the object. From there `--ticks` ticks are timed,
`--repeats` times; medians. Compilation, with one such run, is timed apart. MJX is MuJoCo Warp,
which uses one core of a CPU; native MuJoCo takes them all.

  python benchmarks/engines.py --out FILE.json
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array

from mjx_grasp.cli import run_command
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, Several
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.engines import Engine
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world
from mjx_grasp.tasks.closing import ClosingState, ClosingTask

SCHEMA = "mjx_grasp.engines/1"


@dataclass(frozen=True)
class EnginesConfig(CommandSettings):
    """What to measure."""

    out: Path
    """results file to write (.json)"""
    objects: tuple[str, ...] = ("rubiks_cube",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """start states; the shipped ones by default"""
    worlds: Annotated[tuple[Count, ...], Several()] = (32, 128)
    engines: tuple[Engine, ...] = get_args(Engine)
    warm_up: Count = 80
    """control ticks in native MuJoCo before anything is timed"""
    ticks: Count = 4
    """control ticks of a timed run"""
    repeats: Count = 3
    seed: Seed = 0
    scene: SceneConfig = field(default_factory=lambda: SceneConfig(fix_idle_fingers=True))
    """as training has it"""


def stepper(
    task: ClosingTask, worlds: int
) -> Callable[[ClosingState, int], tuple[ClosingState, Array]]:
    """Control ticks with zero actions, compiled for each count of them."""
    zeros = jnp.zeros((worlds, task.action_size))

    def ticks(state, count):
        def tick(carry, _):
            carry, out = task.tick(carry, zeros)
            return carry, sum(out.rewards.values())

        return jax.lax.scan(tick, state, length=count)

    return jax.jit(ticks, static_argnums=1)


def warm_state(config: EnginesConfig, world: World, worlds: int) -> ClosingState:
    """The state both engines start from, in native MuJoCo's form."""
    task = world.task("mujoco", worlds, TaskConfig())
    state, _ = task.start(task.draw(jax.random.PRNGKey(config.seed), worlds))
    state, _ = stepper(task, worlds)(state, config.warm_up)
    return jax.block_until_ready(state)


def measure(
    config: EnginesConfig, world: World, engine: Engine, warm: ClosingState
) -> dict[str, Any]:
    """The timings of one engine from a state of native MuJoCo."""
    worlds = len(warm.physics.qpos)
    task = world.task(engine, worlds, TaskConfig())
    state = warm
    run = stepper(task, worlds)
    start = time.perf_counter()
    jax.block_until_ready(run(state, config.ticks))
    first = time.perf_counter() - start
    seconds = []
    for _ in range(config.repeats):
        start = time.perf_counter()
        end, _ = jax.block_until_ready(run(state, config.ticks))
        seconds.append(time.perf_counter() - start)
    median = statistics.median(seconds)
    return {
        "engine": engine,
        "worlds": worlds,
        "ms_per_control_tick": 1e3 * median / config.ticks,
        "control_steps_per_s": worlds * config.ticks / median,
        "slowest_over_fastest": max(seconds) / min(seconds),
        "compile_and_first_run_s": first,
        "mean_constraints": float(jnp.mean(end.truth.constraints)),
        "touching_fingers_percent": 100.0 * float(jnp.mean(end.truth.tip_found)),
        "overflows": int(jnp.sum(end.truth.overflow)),
    }


def main(config: EnginesConfig) -> None:
    """Measures, writes the file after each setting, prints the table."""
    check_writable("--out", config.out)
    scene = build_scene_of(config.objects, config.objects_dir, load_robot(), config.scene)
    stored = load_handoffs(
        config.handoffs or shipped_handoffs(config.objects_dir), robot=scene.robot
    )
    names = [o.name for o in scene.objects]
    world = build_world(scene, stored.select(names), TaskConfig().control_dt)
    document = {
        "schema": SCHEMA,
        "provenance": provenance(config.seed),
        "objects": names,
        "substeps": round(TaskConfig().control_dt / config.scene.physics_dt),
        "settings": {k: v for k, v in asdict(config).items() if isinstance(v, int)},
    }
    rows: list[dict[str, Any]] = []
    for worlds in config.worlds:
        warm = warm_state(config, world, worlds)
        for engine in config.engines:
            rows.append(measure(config, world, engine, warm))
            write_json(config.out, document | {"rows": rows})
            print(json.dumps(rows[-1]), flush=True)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(EnginesConfig, description=__doc__)), keeps=False)
