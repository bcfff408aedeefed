"""What a training says of worlds that stop being finite and of buffers that overflow."""

import csv
import sys
from collections import deque
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import tiny_training as tiny

from mjx_grasp.learning import run as run_module
from mjx_grasp.learning.ppo import init_state
from mjx_grasp.learning.run import LoopConfig
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import PhysicsState

BROKEN, FULL = 1, 2
"""The world whose state is made infinite, and the one whose buffers are always too small."""


class Overflowing(NativePhysics):
    """Reports an overflow of one world at every tick."""

    def step(self, state, params, ctrl):
        state, measured, truth = super().step(state, params, ctrl)
        return state, measured, truth._replace(overflow=jnp.arange(len(ctrl)) == FULL)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two iterations: the run's folder, the state it began with, what the progress line said."""
    folder, kept = tmp_path_factory.mktemp("run"), []
    progress = run_module._progress
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny, "NativePhysics", Overflowing)
        patch.setattr(run_module, "_progress", lambda *a: kept.append(progress(*a)) or kept[-1])
        env = tiny.make_env()
        state = init_state(tiny.ppo(), env, seed=0)
        inner = state.env.pipeline_state
        qpos = inner.physics.qpos.at[BROKEN, 9].set(jnp.inf)
        inner = inner._replace(physics=inner.physics._replace(qpos=qpos))
        before = {"qpos": np.array(qpos), "row": np.array(inner.episode.row)}
        state = state._replace(env=state.env.replace(pipeline_state=inner))
        tiny.train_loop(folder, state, env, tiny.ppo(), LoopConfig(), tiny.CONFIG)
    return folder, before, kept[0].tasks[0].description


def test_both_are_counted_in_the_metrics(run):
    with (run[0] / "metrics.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(r["broken_worlds"]) for r in rows] == [1, 0]
    assert [float(r["overflows"]) for r in rows] == [tiny.ppo().unroll] * 2


def test_both_are_in_the_progress_line_with_their_totals(run):
    assert "[red]1 worlds broken[/red]" in run[2]
    assert f"[yellow]{2 * tiny.ppo().unroll} buffer overflows[/yellow]" in run[2]


def test_the_state_before_a_world_broke_is_kept_and_can_be_read(run):
    folder, before, _ = run
    (path,) = folder.glob("broken_world_*.npz")
    assert path.name == "broken_world_00000001.npz"
    with np.load(path) as stored:
        arrays = {name.strip("[]'"): stored[name] for name in stored.files}
    assert set(arrays) == {*PhysicsState._fields, "row"}
    np.testing.assert_array_equal(arrays["qpos"], before["qpos"][BROKEN])
    assert not np.isfinite(arrays["qpos"][9]) and np.isfinite(arrays["ctrl"]).all()
    assert arrays["row"] == before["row"][BROKEN]


@pytest.mark.parametrize(
    ("broken", "overflows", "end"),
    [
        (0.0, 0.0, "1.0 N"),
        (2.0, 0.0, "1.0 N, [red]2 worlds broken[/red]"),
        (0.0, 31.0, "1.0 N, [yellow]31 buffer overflows[/yellow]"),
    ],
)
def test_the_line_names_what_happened_and_nothing_else(broken, overflows, end):
    recent = {name: deque([1.0]) for name in ("return", "success", "force_n")}
    counted = {"broken_worlds": broken, "overflows": overflows}
    assert run_module._describe(10.0, recent, counted).endswith(end)
