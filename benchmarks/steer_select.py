"""From an anchor point to the three targets in one compiled call, beside sorting on the host.

An anchor steers the scores of an object's heatmap, the best candidates of these are what the
selection chooses from, and its choice gives the targets: as one jitted function, `vmap`ped over
worlds with an anchor, a hand and an object pose each; and as two, with the candidates sorted and
gathered by NumPy in between. Medians of `--repeats` calls, compilation apart; both choose alike.

  python benchmarks/steer_select.py --out experiments/results/steer_select_cpu.json
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from mjx_grasp.cli import run_command
from mjx_grasp.geometry import so3
from mjx_grasp.grasp.candidates import Candidates, from_heatmap, vertex_candidates
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.select import HandPose, select, start_selection
from mjx_grasp.grasp.targets import Targets
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.heatmap.steering import Heatmap, steer
from mjx_grasp.objects.model import load_object
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, to_record
from mjx_grasp.robot.spec import load_robot


@dataclass(frozen=True)
class SteerSelectConfig(CommandSettings):
    """What to measure."""

    out: Path
    """results file to write (.json)"""
    object: str = "mustard_bottle"
    """a name of the catalogue; its parametric stand-in [-]"""
    candidates: Count = 256
    """that the selection chooses from [-]"""
    worlds: tuple[Count, ...] = (1, 256)
    """at once [-]"""
    repeats: Count = 21
    """timed calls [-]"""
    seed: Seed = 0
    """of anchors, hands and poses"""


class Worlds(NamedTuple):
    """What differs between worlds; stacked."""

    anchor: Float[Array, "w 3"]
    """what is steered by, object frame [m]"""
    hand: HandPose
    """where the hand is"""
    p_wo: Float[Array, "w 3"]
    """object origin in world [m]"""
    R_wo: Float[Array, "w 3 3"]
    """object rotation"""


def draw(heatmap: Heatmap, count: int, rng: np.random.Generator) -> Worlds:
    """Anchors on the object, which floats, and hands around it."""
    anchors = np.asarray(heatmap.vertices)[rng.integers(0, len(heatmap.vertices), count)]
    p_wo = rng.uniform((0.4, -0.2, 0.2), (0.6, 0.2, 0.3), (count, 3))
    R_wo = jax.vmap(so3.exp)(jnp.asarray(rng.normal(size=(count, 3)), jnp.float32))
    tips = p_wo[:, None] + rng.normal(scale=0.08, size=(count, 3, 3))
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    made = (jnp.asarray(a, jnp.float32) for a in (anchors, tips, axes[:, 0], axes[:, 1], p_wo))
    anchor, tips, approach, opposing, p = made
    return Worlds(anchor, HandPose(tips, approach, opposing), p, R_wo)


def chosen(
    candidates: Candidates, hand: HandPose, p: Float[Array, " 3"], R: Float[Array, "3 3"]
) -> Targets:
    """The targets of the first tick of one world."""
    state = start_selection(candidates, hand, R)
    return select(candidates, state, hand, p, R, SelectionConfig())[0]


def in_one(heatmap: Heatmap, count: int) -> Callable[[Worlds], Targets]:
    """Anchors to targets as one compiled function."""

    def one(anchor: Float[Array, " 3"], *world: Any) -> Targets:
        return chosen(from_heatmap(heatmap, steer(heatmap, anchor), count), *world)

    compiled = jax.jit(jax.vmap(one))
    return lambda worlds: compiled(*worlds)


def over_the_host(heatmap: Heatmap, count: int) -> Callable[[Worlds], Targets]:
    """The same with the candidates sorted and gathered by NumPy."""
    steered = jax.jit(jax.vmap(lambda anchor: steer(heatmap, anchor)))
    selected = jax.jit(jax.vmap(chosen))
    every = jax.tree.map(np.asarray, vertex_candidates(heatmap))

    def run(worlds: Worlds) -> Targets:
        anchor, *world = worlds
        scores = np.where(every.valid, np.asarray(steered(anchor)), 0.0).astype(np.float32)
        order = np.argsort(-scores, axis=1, kind="stable")[:, :count]
        best = jax.tree.map(lambda leaf: leaf[order], every)
        best = best._replace(score=np.take_along_axis(scores, order, axis=1))
        return selected(jax.tree.map(jnp.asarray, best), *world)

    return run


def median_ms(run: Callable[[Worlds], Targets], worlds: Worlds, repeats: int) -> float:
    """Median time of a call, after one that compiles."""
    jax.block_until_ready(run(worlds))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run(worlds))
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def main(config: SteerSelectConfig) -> None:
    """Measures, prints, writes."""
    check_writable("--out", config.out)
    obj = load_object(config.object, None)
    heatmap = jax.tree.map(jnp.asarray, heatmap_of(obj, load_robot().hand))
    one, host = in_one(heatmap, config.candidates), over_the_host(heatmap, config.candidates)
    rows = []
    for count in config.worlds:
        worlds = draw(heatmap, count, np.random.default_rng(config.seed))
        same = np.asarray(one(worlds).candidate) == np.asarray(host(worlds).candidate)
        rows.append(
            {
                "worlds": count,
                "one_call_ms": median_ms(one, worlds, config.repeats),
                "over_the_host_ms": median_ms(host, worlds, config.repeats),
                "same_choice_percent": 100.0 * float(same.mean()),
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    made = {"provenance": provenance(config.seed), "settings": to_record(config)}
    vertices = len(heatmap.vertices)
    write_json(config.out, {**made, "vertices": vertices, "rows": rows})


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(SteerSelectConfig, description=__doc__)), keeps=False)
