"""Trials of a run in blocks: processes share them, and what was cut short goes on with them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from mjx_grasp.evaluation.grasps.results import GraspRow, as_record

TRIALS = 64
"""of a block, about: enough at once to be worth what a batch costs"""


class Block(NamedTuple):
    """Some trials of each object."""

    number: int
    """from 0"""
    episodes: int
    """of each object"""
    seed: int
    """of the poses, the plans and what happens"""


class BlockResult(NamedTuple):
    """What came of them."""

    rows: list[GraspRow]
    seconds: float
    """that it took [s]"""


def blocks_of(episodes: int, objects: int, seed: int) -> list[Block]:
    """The trials of a run, block by block; the same however many processes there are.

    Args:
        episodes: Of each object.
        objects: How many there are.
        seed: Of the run, and of its first block.
    """
    most = max(1, TRIALS // objects)
    blocks = []
    for number, first in enumerate(range(0, episodes, most)):
        own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0] >> 1)
        blocks.append(Block(number, min(most, episodes - first), own if number else seed))
    return blocks


class Begun:
    """Runs of which some blocks are done.

    Args:
        record: What an interrupted run has left in `record`.
    """

    def __init__(self, record: dict[str, dict[str, Any]] | None = None):
        self.record = record or {}
        """of each run by name what it is of, and seconds and rows by block; for a file"""

    def left(self, name: str, about: dict[str, Any], blocks: list[Block]) -> list[Block]:
        """Blocks of a run that are still to be done.

        Args:
            name: Of the run.
            about: What decides its results, as in a file; of something else nothing counts.
            blocks: All of it.
        """
        if self.record.get(name, {}).get("about") != about:
            self.record.pop(name, None)
        done = self.record.get(name, {}).get("blocks", {})
        return [block for block in blocks if str(block.number) not in done]

    def add(
        self,
        name: str,
        about: dict[str, Any],
        blocks: list[Block],
        block: Block,
        found: BlockResult,
    ) -> dict[str, Any] | None:
        """Takes what came of a block.

        Args:
            name, about, blocks: As of `left`.
            block: Which.
            found: What came of it.

        Returns:
            What the run is of, its seconds, sums and rows, once no block is missing; it is
            forgotten here then.
        """
        done = self.record.setdefault(name, {"about": about, "blocks": {}})["blocks"]
        rows = [asdict(row) for row in found.rows]
        done[str(block.number)] = {"seconds": round(found.seconds, 1), "rows": rows}
        if self.left(name, about, blocks):
            return None
        del self.record[name]
        parts = [done[str(each.number)] for each in blocks]
        every = [_row(row) for part in parts for row in part["rows"]]
        seconds = round(sum(part["seconds"] for part in parts), 1)
        return about | {"seconds": seconds, **as_record(every)}


def _row(record: dict[str, Any]) -> GraspRow:
    """A row as it was before it was in a file."""
    tips = record["tip_error_mm"]
    return GraspRow(**record | {"tip_error_mm": None if tips is None else tuple(tips)})
