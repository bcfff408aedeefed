"""The start states that ship with the package, for trainings that would make the very same ones."""

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


def take_shipped(wanted: HandoffConfig) -> bool:
    """Copies the shipped set to where a set is wanted, if its settings are those that it came from.

    Args:
        wanted: The set; its report goes beside it, as if it had been made.

    Returns:
        Whether it is; otherwise nothing is written.
    """
    states = asset_path(SHIPPED)
    report = states.with_suffix(".json")
    made_of = read_json(report, "the report of the shipped start states")["config"]
    if _but_for_the_file(made_of) != _but_for_the_file(to_record(unspread(wanted))):
        return False
    out = Path(wanted.out)
    for source, path in ((report, out.with_suffix(".json")), (states, out)):
        with replacing(path) as temporary:
            shutil.copyfile(source, temporary)
    return True


def _but_for_the_file(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name != "out"}
