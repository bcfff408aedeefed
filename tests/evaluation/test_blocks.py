"""Trials in blocks: what they are, and that nothing of them is lost or counted twice."""

import json

import pytest
from grasp_rows import row
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.evaluation.grasps.blocks import TRIALS, Begun, BlockResult, blocks_of
from mjx_grasp.evaluation.grasps.results import as_record

ABOUT = {"settings": {"hold_s": 1.0}}


def rows(outcome, count):
    return [row(outcome) for _ in range(count)]


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


def test_a_run_is_whole_once_no_block_is_missing():
    blocks, begun = blocks_of(20, 8, 0), Begun()
    found = [rows("success", 64), rows("slipped", 64), rows("success", 32)]
    assert begun.left("calm", ABOUT, blocks) == blocks
    for k in (2, 0):
        assert begun.add("calm", ABOUT, blocks, blocks[k], BlockResult(found[k], 1.5)) is None
    assert begun.left("calm", ABOUT, blocks) == [blocks[1]]
    whole = begun.add("calm", ABOUT, blocks, blocks[1], BlockResult(found[1], 2.0))
    together = as_record([row for part in found for row in part])
    assert whole == ABOUT | {"seconds": 5.0} | together
    assert begun.record == {}


def test_what_a_file_keeps_of_a_run_is_gone_on_with_and_of_another_run_is_not():
    blocks, before = blocks_of(16, 8, 0), Begun()
    before.add("calm", ABOUT, blocks, blocks[0], BlockResult(rows("success", 64), 1.0))
    kept = json.loads(json.dumps(before.record))
    after = Begun(kept)
    assert after.left("calm", ABOUT, blocks) == [blocks[1]]
    whole = after.add("calm", ABOUT, blocks, blocks[1], BlockResult(rows("hit", 64), 1.0))
    assert (whole["all"]["success"], whole["all"]["hit"]) == (64, 64)
    windy = {"settings": {"hold_s": 3.0}}
    other = Begun(json.loads(json.dumps(before.record)))
    assert other.left("calm", windy, blocks) == blocks and not other.record


@pytest.mark.parametrize("name", ["calm", "windy"])
def test_runs_do_not_mix(name):
    blocks, begun = blocks_of(9, 8, 0), Begun()
    for each in ("calm", "windy"):
        begun.add(each, ABOUT, blocks, blocks[0], BlockResult(rows("success", 64), 1.0))
    whole = begun.add(name, ABOUT, blocks, blocks[1], BlockResult(rows("hit", 8), 1.0))
    assert whole["all"]["trials"] == 72 and list(begun.record) == [
        "windy" if name == "calm" else "calm"
    ]
