"""Several seeds of a training in step, the worlds of all as one batch, against one seed alone.

Timed are whole PPO iterations of a preset, compiled: the median of `--repeats`, and the compilation
apart.

  python benchmarks/seeds.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.ppo import init_state, make_iteration
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.tasks.assemble import build_scene_of, build_world
from mjx_grasp.training.config import settings_of

SCHEMA = "mjx_grasp.seeds/1"


@dataclass(frozen=True)
class SeedsConfig(CommandSettings):
    """What to time."""

    out: Path
    preset: str = "paper"
    """whose scene, task and PPO are trained, in MJX"""
    counts: tuple[Count, ...] = (1, 2, 4, 8)
    """seeds that are trained together [-]"""
    worlds: Count = 1024
    """of each seed [-]"""
    unroll: Count = 64
    """control steps per world and iteration [-]"""
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """handoff set; the one that goes with the objects by default"""
    repeats: Count = 5
    """timed iterations [-]"""
    seed: Seed = 0
    """the first one"""


def measured(config: SeedsConfig, env: BraxTask, ppo: PPOConfig, count: int) -> dict[str, Any]:
    """Seconds of an iteration of so many seeds."""
    states = [init_state(ppo, env, config.seed + k) for k in range(count)]
    state, step = states[0], make_iteration(ppo, env)
    if count > 1:
        state, step = jax.tree.map(lambda *x: jnp.stack(x), *states), jax.vmap(step)
    iteration, times = jax.jit(step, donate_argnums=0), []
    for _ in range(config.repeats + 2):
        start = time.perf_counter()
        state, metrics = iteration(state)
        jax.block_until_ready(metrics)
        times.append(time.perf_counter() - start)
    seconds = statistics.median(times[2:])
    steps = count * ppo.steps_per_iteration
    memory = jax.devices()[0].memory_stats() or {}
    return {
        "seeds": count,
        "worlds": ppo.worlds,
        "unroll": ppo.unroll,
        "compile_s": times[0] - seconds,
        "iteration_s": seconds,
        "iterations_s": times[2:],
        "steps_per_s": steps / seconds,
        "peak_bytes": memory.get("peak_bytes_in_use"),
        "overflows": float(jnp.sum(metrics["overflows"])),
    }


def main(config: SeedsConfig) -> None:
    """Times one count after the other and writes the file after each."""
    check_writable("--out", config.out)
    preset, robot, made = settings_of(config.preset), load_robot(), provenance(config.seed)
    scene = build_scene_of(config.objects, config.objects_dir, robot, preset.scene)
    stored = load_handoffs(config.handoffs or shipped_handoffs(config.objects_dir), robot=robot)
    names, _ = eligible(scene.object_names, stored)
    world = build_world(scene, states_of(stored, names, "training"), preset.task.control_dt)
    ppo = replace(preset.ppo, worlds=config.worlds, unroll=config.unroll)
    task = world.task("mjx", ppo.worlds, preset.task, preset.noise, ppo.privileged_critic)
    env, rows = BraxTask(task, ppo.worlds, ppo.stagger), []
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("seeds", total=len(config.counts))
        for count in config.counts:
            rows.append(measured(config, env, ppo, count))
            record = {
                "schema": SCHEMA,
                "settings": to_record(config),
                "rows": rows,
                "physics_dt": preset.scene.physics_dt,
                "provenance": made,
            }
            write_json(config.out, record)
            bar.update(job, advance=1)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(SeedsConfig, description=__doc__)), keeps=False)
