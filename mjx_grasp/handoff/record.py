"""An object's states and their report as JSON, for work that is not finished yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from mjx_grasp.handoff.dataset import ARRAYS, HandoffSet
from mjx_grasp.handoff.report import ObjectReport
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.records.archive import packed, unpacked
from mjx_grasp.robot.description import RobotSpec


def as_record(states: HandoffSet, report: ObjectReport) -> dict[str, Any]:
    """States of one object and the report of them, as JSON types and to the bit."""
    arrays = {name: getattr(states, name) for name in ARRAYS}
    said = vars(report) | {"rejected": dict(report.rejected)}
    return {"states": packed(arrays), "report": said}


def from_record(
    record: Mapping[str, Any], obj: ObjectModel, robot: RobotSpec
) -> tuple[HandoffSet, ObjectReport]:
    """What `as_record` was given.

    Args:
        record: Its result.
        obj: The object.
        robot: Whose states they are.
    """
    states = HandoffSet(
        **unpacked(record["states"]),
        object_names=(obj.name,),
        object_content_hash=(obj.content_hash,),
        robot=robot.identity,
    )
    said = record["report"]
    return states, ObjectReport(**said | {"rejected": Counter(said["rejected"])})
