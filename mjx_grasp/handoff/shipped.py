"""The start states that ship with the package, for trainings that would make such ones."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from mjx_grasp.assets import asset_path
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.records.atomic import read_json, replacing
from mjx_grasp.records.settings import to_record
from mjx_grasp.records.spread import unspread

SHIPPED = "handoffs_cube.npz"
"""Reached states of the stand-in that the preset `cpu` trains on; its report is beside it."""


def shipped_for(wanted: HandoffConfig) -> Path | None:
    """The shipped set, if its settings are those of a set that is wanted; its report tells.

    Settings alone are compared: it may be of an earlier revision of the code.

    Args:
        wanted: What would be made.

    Raises:
        FileError: The set or its report cannot be read.
    """
    states = asset_path(SHIPPED)
    report = read_json(states.with_suffix(".json"), "the report of the shipped start states")
    made_of = _but_for_the_file(report.get("config", {}))
    return states if made_of == _but_for_the_file(to_record(unspread(wanted))) else None


def take_shipped(shipped: Path, out: Path) -> None:
    """Copies a set, and its report beside it.

    Args:
        shipped: The set.
        out: Where it is wanted.
    """
    for source, path in (
        (shipped.with_suffix(".json"), out.with_suffix(".json")),
        (shipped, out),
    ):
        with replacing(path) as temporary:
            shutil.copyfile(source, temporary)


def _but_for_the_file(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name != "out"}
