"""Control steps per second of the whole PPO loop, against plain MuJoCo Warp on the same scene.

For each number of worlds it times, on the same device in the same process:

  warp       MuJoCo Warp alone, the control tick's physics steps in one CUDA graph, no JAX;
             `warp_own_tolerance` with the solver's tolerance that it sets for itself, 1e-6, at
             which it stops earlier than in any of the others
  mjx        the same steps called from JAX, tick by tick, inside a jitted scan
  task       the closing environment (commands, readings, rewards, stages, resets), given actions
  rollout    the same with the policy and the record of transitions
  ppo        whole PPO iterations: rollout and updates
  sharded    the same over a mesh of this one device, as several devices train

and, on a GPU, where MuJoCo Warp's own time goes, by its event trace.

All loops but the last two go through the same states: those of one rollout of a running training
when `ppo` has been timed, with its commands and resets. `warp` and `mjx` are given each tick's
anew, `task` the rollout's actions. `ppo` and `sharded` are trainings, one after the other. Scene,
task and PPO are those of a preset of `mjx_grasp.train`.
Medians of `--repeats` runs; compilation is timed apart.

  python benchmarks/throughput.py --objects-dir DIR --out FILE.json
"""

from __future__ import annotations

import functools
import json
import re
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from brax.training import acting
from brax.training.agents.ppo import networks
from jax.sharding import Mesh

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.results import ThroughputRow, write_results
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, states_of
from mjx_grasp.learning import ppo
from mjx_grasp.learning.brax_env import EPISODE_FIELDS, BraxTask
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.devices import AXIS, Devices
from mjx_grasp.learning.memory import bytes_per_world
from mjx_grasp.records.atomic import check_writable
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.mjx_engine import MjxPhysics
from mjx_grasp.sim.physics import PhysicsState, WorldParams
from mjx_grasp.tasks.assemble import build_scene_of, build_world
from mjx_grasp.training.config import settings_of


@dataclass(frozen=True)
class BenchmarkConfig(CommandSettings):
    """What to measure."""

    out: Path
    preset: Literal["gpu", "paper"] = "gpu"
    """whose scene, task and PPO are timed"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    settings: tuple[str, ...] = ("4096x16", "8192x16")
    """worlds x unroll, taken apart layer by layer"""
    sizes: tuple[str, ...] = ()
    """worlds x unroll of which whole PPO iterations alone are timed"""
    warm_up: Count = 6
    """PPO iterations before anything is timed"""
    repeats: Count = 20
    seed: Seed = 0


Recorded = tuple[PhysicsState, WorldParams]
"""What physics is given at each tick, [tick, world, …]: state with command, and parameters."""


def _timed(function: Callable, *given: Any, repeats: int) -> tuple[Any, float, float]:
    """Times a function.

    Returns:
        What it returned; seconds until then, most of them of compiling; the median of the runs
        after that [s].
    """
    jitted = jax.jit(function)

    def run() -> tuple[Any, float]:
        begun = time.perf_counter()
        found = jax.block_until_ready(jitted(*given))
        return found, time.perf_counter() - begun

    found, compile_s = run()
    return found, compile_s, statistics.median(run()[1] for _ in range(repeats))


def plain_warp(
    physics: MjxPhysics, ticks: Recorded, repeats: int, tolerance: float | None = None
) -> tuple[float, dict[str, float]]:
    """MuJoCo Warp alone, replaying one CUDA graph per tick; putting the states there is not timed.

    Args:
        physics: The same steps in MJX.
        ticks: What they are given.
        repeats: Runs over all ticks.
        tolerance: At which the solver stops. Warp would raise the scene's to 1e-6, where MJX
            leaves it: None keeps what Warp sets.

    Returns:
        Seconds per control tick, and the milliseconds of a physics step's parts (GPU only).
    """
    import mujoco.mjx.third_party.mujoco_warp as mjw
    import warp as wp

    worlds, model, on_gpu = physics.num_worlds, physics.scene.model, wp.get_device().is_cuda
    m = mjw.put_model(model)
    m.opt.warn_overflow = False
    if tolerance is not None:
        m.opt.tolerance.fill_(tolerance)
    d = mjw.make_data(model, nworld=worlds, **physics.buffers)

    state, params = ticks
    states = {"qacc_warmstart" if n == "warmstart" else n: x for n, x in state._asdict().items()}
    count = len(state.qpos)
    given = [
        (owner, name, np.asarray(values))
        for owner, fields in ((d, states), (m, jax.vmap(physics.world_fields)(params)))
        for name, values in fields.items()
    ]
    rows = [
        [
            (owner, name, wp.array(x[tick], dtype=getattr(owner, name).dtype))
            for owner, name, x in given
        ]
        for tick in range(count)
    ]
    for owner, name, field in rows[0]:
        if owner is m:  # one row for all worlds until now
            setattr(m, name, wp.clone(field))

    def put(tick: int) -> None:
        for owner, name, field in rows[tick]:
            wp.copy(getattr(owner, name), field)
        wp.synchronize()

    def step() -> None:
        for _ in range(physics.substeps):
            mjw.step(m, d)

    put(0)
    step()
    if on_gpu:
        with wp.ScopedCapture() as capture:
            step()
        begun, ended = (wp.Event(enable_timing=True) for _ in range(2))

    def seconds() -> float:
        if not on_gpu:
            start = time.perf_counter()
            step()
            return time.perf_counter() - start
        wp.record_event(begun)
        wp.capture_launch(capture.graph)
        wp.record_event(ended)
        return 1e-3 * wp.get_event_elapsed_time(begun, ended)

    sums = np.zeros(repeats)
    for k in range(repeats):
        for tick in range(count):
            put(tick)
            sums[k] += seconds()
    trace_ms = traced(lambda: mjw.step(m, d)) if on_gpu else {}
    return float(np.median(sums)) / count, trace_ms


def traced(step: Callable[[], None], repeats: int = 20) -> dict[str, float]:
    """Median milliseconds of each part of a physics step, by MuJoCo Warp's event trace."""
    import warp as wp
    from mujoco.mjx.third_party.mujoco_warp._src.warp_util import EventTracer

    times: dict[str, list[float]] = {}

    def collect(trace: dict, prefix: str = "") -> None:
        for name, (events, inner) in trace.items():
            times.setdefault(prefix + name, []).append(sum(events))
            collect(inner, f"{prefix}{name}/")

    with EventTracer(enabled=True) as tracer:
        with wp.ScopedCapture() as capture:
            step()
        for _ in range(repeats):
            wp.capture_launch(capture.graph)
            wp.synchronize()
            collect(tracer.trace())
    return {name: statistics.median(ms) for name, ms in times.items()}


class Loop:
    """A training: where it stands after being timed, and its median seconds per control tick.

    One at a time: two that take turns, iteration by iteration, slow each other down on a GPU.
    """

    def __init__(self, settings: PPOConfig, env: BraxTask, config: BenchmarkConfig):
        self.state = ppo.init_state(settings, env, config.seed)
        self._iteration = jax.jit(ppo.make_iteration(settings, env), donate_argnums=0)
        self.compile_s = self._timed()
        for _ in range(config.warm_up):
            self._timed()
        times = [self._timed() for _ in range(config.repeats)]
        self.seconds = statistics.median(times) / settings.unroll

    def _timed(self) -> float:
        start = time.perf_counter()
        self.state, self.metrics = self._iteration(self.state)
        jax.block_until_ready(self.metrics)
        return time.perf_counter() - start


def sharded(env: BraxTask, stagger: bool) -> BraxTask:
    """The same worlds on a mesh of one device."""
    mesh = Mesh(np.array(jax.devices()[:1]), (AXIS,))
    return BraxTask(env.task, env.worlds, stagger, Devices(mesh))


def measure(config: BenchmarkConfig, worlds: int, unroll: int, layers: bool) -> dict[str, Any]:
    """The timings of one setting: of whole PPO iterations, and of the layers below if wanted."""
    preset, robot = settings_of(config.preset), load_robot()
    scene = build_scene_of(config.objects, config.objects_dir, robot, preset.scene)
    file = config.handoffs or shipped_handoffs(config.objects_dir)
    stored = load_handoffs(file, scene.objects, robot)
    states = states_of(stored, scene.object_names, "training")
    world = build_world(scene, states, preset.task.control_dt)
    settings = replace(preset.ppo, worlds=worlds, unroll=unroll)
    task = world.task("mjx", worlds, preset.task, preset.noise, settings.privileged_critic)
    env = BraxTask(task, worlds, settings.stagger)

    loop = Loop(settings, env, config)
    state, metrics = loop.state, loop.metrics
    memory = jax.devices()[0].memory_stats() or {}
    compile_s, seconds = {"ppo": loop.compile_s}, {"ppo": loop.seconds}
    del loop
    if layers:
        twin = Loop(settings, sharded(env, settings.stagger), config)
        compile_s["sharded"], seconds["sharded"] = twin.compile_s, twin.seconds
        del twin
    inner = state.env.pipeline_state
    found = {
        "worlds": worlds,
        "unroll": unroll,
        "objects": len(scene.objects),
        "pieces": len(scene.addresses.object_geoms),
        "degrees_of_freedom": int(scene.model.nv),
        "bytes_per_world": bytes_per_world(scene, unroll),
        "peak_bytes": memory.get("peak_bytes_in_use"),
        "mean_constraints": float(jnp.mean(inner.truth.constraints)),
        "max_constraints": int(jnp.max(inner.truth.constraints)),
        "physics_dt": preset.scene.physics_dt,
        "substeps": task.physics.substeps,
        "solver_iterations": [
            preset.scene.solver_iterations,
            preset.scene.line_search_iterations,
        ],
        "overflows": float(metrics["overflows"]),
        "compile_s": compile_s,
    }
    if layers:
        found |= _layers(config, settings, env, state, seconds, compile_s)
    found["ms_per_control_tick"] = {name: 1e3 * s for name, s in seconds.items()}
    found["control_steps_per_s"] = {name: worlds / s for name, s in seconds.items()}
    return found


def _layers(
    config: BenchmarkConfig,
    settings: PPOConfig,
    env: BraxTask,
    state: ppo.TrainState,
    seconds: dict[str, float],
    compile_s: dict[str, float],
) -> dict[str, Any]:
    """Adds the seconds per tick of every layer below PPO, in the states of a training's rollout."""
    unroll, physics = settings.unroll, env.task.physics
    nets = ppo.make_networks(settings, env)
    policy = networks.make_inference_fn(nets)(
        (state.normalizer, state.params.policy, state.params.value)
    )
    start = state.env

    def rollout(start):
        key = jax.random.PRNGKey(0)
        final, seen = acting.generate_unroll(
            env, start, policy, key, unroll, extra_fields=EPISODE_FIELDS
        )
        return seen.action, final.obs, jax.tree.map(jnp.sum, seen)

    def task(start, actions):
        def tick(s, action):
            s = env.step(s, action)
            return s, jnp.sum(s.reward)

        final, reward = jax.lax.scan(tick, start, actions)
        return final.obs, reward

    def record(s, actions):
        def tick(s, action):
            before = s.pipeline_state
            commanded = env.task.tick(before, action)[0].physics.ctrl
            given = before.physics._replace(ctrl=commanded)
            return env.step(s, action), (given, before.params)

        return jax.lax.scan(tick, s, actions)[1]

    def mjx(ticks):
        def tick(last, row):
            given, params = row
            state, measured, _ = physics.step(given, params, given.ctrl)
            return state, measured.q

        return jax.lax.scan(tick, start.pipeline_state.physics, ticks)

    timed = functools.partial(_timed, repeats=config.repeats)
    (actions, *_), compile_s["rollout"], rollout_s = timed(rollout, start)
    _, compile_s["task"], task_s = timed(task, start, actions)
    ticks: Recorded = jax.jit(record)(start, actions)
    _, compile_s["mjx"], mjx_s = timed(mjx, ticks)
    for name, whole in (("rollout", rollout_s), ("task", task_s), ("mjx", mjx_s)):
        seconds[name] = whole / unroll
    scenes = physics.scene.model.opt.tolerance
    seconds["warp"], trace_ms = plain_warp(physics, ticks, config.repeats, scenes)
    seconds["warp_own_tolerance"], _ = plain_warp(physics, ticks, config.repeats)
    return {
        "ratio_ppo_to_warp": seconds["warp"] / seconds["ppo"],
        "warp_step_trace_ms": trace_ms,
    }


def throughput_rows(details: list[dict[str, Any]]) -> list[ThroughputRow]:
    """The timings as rows of a results file."""
    loops = {"ppo": "ppo", "sharded": "ppo_sharded", "task": "env"}
    loops |= {"mjx": "physics", "warp": "mujoco_warp"}
    return [
        ThroughputRow(
            loop=loop,
            engine="mjx",
            worlds=d["worlds"],
            objects=d["objects"],
            control_steps_per_s=d["control_steps_per_s"][name],
            memory_gib=d["peak_bytes"] / 2**30 if name == "ppo" and d["peak_bytes"] else None,
        )
        for d in details
        for name, loop in loops.items()
        if name in d["control_steps_per_s"]
    ]


def setting_of(word: str) -> tuple[int, int]:
    """Worlds and unroll.

    Raises:
        InputError: It says something else.
    """
    found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", word)
    if found is None:
        raise InputError("--settings and --sizes", word, "WORLDSxUNROLL")
    return int(found[1]), int(found[2])


def main(config: BenchmarkConfig) -> None:
    """Measures, prints each setting and writes the file after each of them."""
    check_writable("--out", config.out)
    # As `find_devices` does for several; now, as a change of it compiles everything anew.
    jax.config.update("jax_use_shardy_partitioner", False)
    details = []
    # Ascending: the peak of memory is that of the process so far.
    pairs = {setting_of(word): word for word in (*config.sizes, *config.settings)}
    for (worlds, unroll), setting in sorted(pairs.items()):
        details.append(measure(config, worlds, unroll, layers=setting in config.settings))
        print(json.dumps(details[-1], indent=1), flush=True)
        rows, made = throughput_rows(details), provenance(config.seed)
        robot = load_robot().identity
        write_results(config.out, rows, made, robot, details=details)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchmarkConfig, description=__doc__)), keeps=False)
