"""Trials of a run in blocks, the same on every machine, and in parts that run at once.

Processes share the parts, and a run that was killed loses none that is finished.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_grasp.evaluation.grasps.results import GraspRow, as_record
from mjx_grasp.sim.engines import Engine

TRIALS = 64
"""of a block, about: enough at once to be worth what a batch costs on a CPU"""
TRIALS_AT_ONCE = 512
"""of a part in native MuJoCo beside a GPU, about: a tick of few takes it hardly less time, and
MuJoCo steps more of them far longer than the tick takes; processes can share the parts"""
TRIALS_IN_MJX = 4096
"""of one where the GPU steps them too"""


class Block(NamedTuple):
    """Some trials of each object."""

    number: int
    """from 0"""
    episodes: int
    """of each object"""
    seed: int
    """of the poses and headings, the plans and the noise"""


Part = tuple[Block, ...]
"""Blocks that are run at once."""


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


def parts_of(blocks: Sequence[Block], objects: int, engine: Engine = "mujoco") -> list[Part]:
    """The blocks of a run, a part at a time: each alone on a CPU, many at once on a GPU.

    Args:
        blocks: All of them.
        objects: How many objects there are.
        engine: What steps the physics.
    """
    most = 1
    if jax.default_backend() != "cpu":
        together = TRIALS_IN_MJX if engine == "mjx" else TRIALS_AT_ONCE
        most = max(1, together // (objects * max(block.episodes for block in blocks)))
    return [tuple(blocks[k : k + most]) for k in range(0, len(blocks), most)]


def joined(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What a results file holds of a run: seconds, sums and rows.

    Args:
        parts: Seconds and rows of all of its parts, in their order (`Makers.part`).
    """
    every = [_row(row) for part in parts for row in part["rows"]]
    return {"seconds": round(sum(part["seconds"] for part in parts), 1), **as_record(every)}


def _row(record: dict[str, Any]) -> GraspRow:
    """A row as it was before it was in a file."""
    tips = record["tip_error_mm"]
    return GraspRow(**record | {"tip_error_mm": None if tips is None else tuple(tips)})
