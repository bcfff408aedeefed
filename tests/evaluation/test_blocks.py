"""Trials in blocks: what they are, and that nothing of them is lost or counted twice."""

import json
from dataclasses import asdict

import jax
import pytest
from grasp_rows import row
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.evaluation.grasps.blocks import (
    TRIALS,
    TRIALS_AT_ONCE,
    TRIALS_IN_MJX,
    blocks_of,
    joined,
    parts_of,
)
from mjx_grasp.evaluation.grasps.results import as_record


@given(episodes=st.integers(1, 500), objects=st.integers(1, 100), seed=st.integers(0, 2**31))
def test_blocks_are_all_trials_and_no_two_draw_alike(episodes, objects, seed):
    blocks = blocks_of(episodes, objects, seed)
    assert sum(block.episodes for block in blocks) == episodes
    assert [block.number for block in blocks] == list(range(len(blocks)))
    assert all(b.episodes * objects <= max(TRIALS, objects) for b in blocks)
    assert blocks[0].seed == seed
    assert len({block.seed for block in blocks}) == len(blocks)
    assert all(0 <= block.seed < 2**32 for block in blocks)


def test_a_longer_run_begins_with_the_blocks_of_a_shorter_one():
    short, long = blocks_of(16, 8, 3), blocks_of(40, 8, 3)
    assert long[: len(short)] == short
    assert not {b.seed for b in long[1:]} & {b.seed for b in blocks_of(40, 8, 4)[1:]}


def test_a_run_is_its_blocks_together_in_a_journal_too():
    """Seconds, sums and rows are those of all trials at once."""
    found = [[row("success"), row("slipped")], [row("hit")]]
    parts = [{"seconds": 1.5, "rows": [asdict(each) for each in rows]} for rows in found]
    every = as_record([*found[0], *found[1]])
    assert joined(parts) == {"seconds": 3.0} | every
    assert joined(json.loads(json.dumps(parts))) == {"seconds": 3.0} | every


@given(
    *(st.integers(1, most) for most in (500, 100)),
    *map(st.sampled_from, (("cpu", "gpu"), ("mujoco", "mjx"))),
)
def test_parts_are_all_blocks_and_a_gpu_runs_many_at_once(episodes, objects, device, engine):
    blocks = blocks_of(episodes, objects, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: device)
        parts = parts_of(blocks, objects, engine)
    assert [block for part in parts for block in part] == blocks
    trials = [objects * sum(block.episodes for block in part) for part in parts]
    if device == "cpu":
        assert all(len(part) == 1 for part in parts)
    else:
        together = TRIALS_IN_MJX if engine == "mjx" else TRIALS_AT_ONCE
        assert all(n <= max(together, objects) for n in trials)
        least = together - max(TRIALS, objects)
        assert all(n > least for n in trials[:-1]), "no part is smaller than need be"
