"""The start states that ship with the package, for trainings that would make such ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mjx_grasp.assets import asset_path
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.objects.model import ObjectModel


class ShippedSet(NamedTuple):
    """A set of reached states in `assets/`, made by the settings that `handoffs` has by default."""

    file: str
    scans: bool
    """of real scans; else of stand-ins"""
    per_object: int
    """how many of each object were looked for; in a few rounds, of some fewer were found"""

    @property
    def path(self) -> Path:
        """Where it is."""
        return asset_path(self.file)


SHIPPED = (
    ShippedSet("handoffs_cube.npz", scans=False, per_object=256),
    ShippedSet("handoffs_standins.npz", scans=False, per_object=128),
    ShippedSet("handoffs_reached.npz", scans=True, per_object=128),
)
"""The smallest first."""
_ASKED = ("objects", "objects_dir", "out", "seed", "per_object", "kind", "processes", "address")
"""Settings that do not change what a single state is, or are looked at one by one."""


def shipped_for(wanted: HandoffConfig, objects: Sequence[ObjectModel]) -> Path | None:
    """The first shipped set that would do in a set's place: of its objects, kind and settings.

    It has at least as many states as are wanted of each object, or all of so many that were found.
    Whatever the seed, the states are the same. They may be of an earlier revision of the code.

    Args:
        wanted: What would be made.
        objects: Its objects, as they are here.

    Returns:
        The set's file; None where states have to be made.

    Raises:
        FileError: A shipped set cannot be read.
    """
    usual = HandoffConfig(out=wanted.out)
    others = (name for name in vars(wanted) if name not in _ASKED)
    if wanted.kind != "reached" or any(getattr(wanted, n) != getattr(usual, n) for n in others):
        return None
    hashes = {obj.name: obj.content_hash for obj in objects}
    for each in SHIPPED:
        if each.scans == (wanted.objects_dir is None):
            continue
        stored = load_handoffs(each.path)
        there = zip(stored.object_names, stored.object_content_hash, strict=True)
        if hashes.items() <= set(there):
            counts = stored.counts()
            if all(_enough(counts[name], each, wanted.per_object) for name in hashes):
                return each.path
    return None


def _enough(count: int, each: ShippedSet, wanted: int) -> bool:
    """Whether an object's states are as many as are wanted, or all of so many that there were."""
    return count > 0 and max(count, each.per_object) >= wanted
