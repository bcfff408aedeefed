"""Which states of a handoff set are used: the shipped sets, objects with states, their parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjx_grasp.assets import asset_path
from mjx_grasp.handoff.dataset import HandoffSet


def shipped_handoffs(objects_dir: Path | None) -> Path:
    """The shipped handoff set of the eight: for real scans with a folder, else for stand-ins."""
    return asset_path("handoffs_standins.npz" if objects_dir is None else "handoffs_reached.npz")


def eligible(names: Sequence[str], handoffs: HandoffSet) -> tuple[list[str], list[str]]:
    """Splits objects into those with start states and those without."""
    have = set(np.asarray(handoffs.object_names)[np.unique(handoffs.object_index)])
    return [n for n in names if n in have], [n for n in names if n not in have]


def with_states(
    names: Sequence[str], handoffs: HandoffSet, part: str
) -> tuple[list[str], list[str], HandoffSet]:
    """Objects that have states in a part of the set, those that have none, and the former's states.

    A single state of an object is the training's: such an object has none to be evaluated from.
    """
    stored = states_of(handoffs, [n for n in names if n in handoffs.object_names], part)
    have, without = eligible(names, stored)
    return have, without, stored.select(have)


def states_of(handoffs: HandoffSet, names: Sequence[str], part: str) -> HandoffSet:
    """The named objects' states of a part of the set."""
    chosen = handoffs.select(names)
    if part == "all":
        return chosen
    training, evaluation = chosen.split()
    return training if part == "training" else evaluation
