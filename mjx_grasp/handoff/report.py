"""What became of the candidates: counts, a table for people, JSON for machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from mjx_grasp.errors import FileError
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.sim.collision import REASONS

# Why a candidate at an object pose came to nothing, the one that got farthest last.
OUTCOMES = (
    *("no-candidate", "not-reached", "unreachable", "limits", "reach-axis"),
    *("lift", "touch", "hold"),
    *reversed(REASONS),
)


TIPS = ("thumb", "index", "middle", "midpoint")
"""Whose errors a report says."""


@dataclass
class ObjectReport:
    """What became of an object's candidates, counted per (object pose, candidate).

    Of a reached handoff the pair is that of the pose and what the selection took there.

    Attributes:
        name: The object.
        kind: 'ik' or 'reached'.
        eligible_candidates: Heatmap vertices with a sufficient score.
        poses: Object poses drawn.
        poses_without_candidate: Of those, without a candidate high enough above the table.
        sampled: Pairs of pose and candidate tried.
        converged: Pairs for which some start met the tolerance at every tip.
        rejected: Pairs by reason: the one met by the start that got farthest.
        feasible: Pairs with a state that is accepted.
        kept: States in the set.
        seconds: Time taken.
        reach_seconds: Time that each reach took whose end was accepted [s].
        tip_error_mm: Of the states kept, by tip and of the three tips together: mean, spread and
            median distance to the standoff targets.
    """

    name: str
    kind: str = "ik"
    eligible_candidates: int = 0
    poses: int = 0
    poses_without_candidate: int = 0
    sampled: int = 0
    converged: int = 0
    rejected: Counter = field(default_factory=Counter)
    feasible: int = 0
    kept: int = 0
    seconds: float = 0.0
    reach_seconds: list[float] = field(default_factory=list)
    tip_error_mm: dict[str, dict[str, float]] = field(default_factory=dict)

    def keep(self, states: HandoffSet, seconds: float) -> None:
        """Says what is kept, and how near its tips are.

        Args:
            states: Those of the set, of this object and kind.
            seconds: Time taken.
        """
        self.kept, self.seconds = len(states), seconds
        self.tip_error_mm = tip_errors(states)

    @property
    def eligible(self) -> bool:
        """Whether the object has any pre-grasp."""
        return self.kept > 0

    @property
    def feasible_share(self) -> float:
        """Share of the pairs of pose and candidate that have an accepted state."""
        return self.feasible / self.sampled if self.sampled else 0.0

    def _percentiles(self) -> dict[str, float] | None:
        """Of the times of reaching; None without any."""
        times = self.reach_seconds
        return (
            {f"{p}": round(float(np.percentile(times, p)), 2) for p in (50, 95)} if times else None
        )

    def as_row(self) -> dict[str, Any]:
        """The report as JSON types, with every reason counted."""
        rejected = {reason: self.rejected[reason] for reason in OUTCOMES}
        derived = {
            "rejected": rejected,
            "seconds": round(self.seconds, 2),
            "reach_seconds": self._percentiles(),
            "eligible": self.eligible,
            "feasible_share": round(self.feasible_share, 4),
        }
        return asdict(self) | derived


def tip_errors(states: HandoffSet) -> dict[str, dict[str, float]]:
    """Distances of tips to their standoff targets: mean, spread and median [mm].

    Args:
        states: Those that count; without any there is nothing to say.
    """
    if not len(states):
        return {}
    tips = dict(zip(TIPS, (*states.residual.T, states.midpoint), strict=True))
    found = {"tips": states.residual.mean(axis=1), **tips}
    return {
        name: {
            "mean": round(1e3 * float(values.mean()), 3),
            "std": round(1e3 * float(values.std()), 3),
            "median": round(1e3 * float(np.median(values)), 3),
        }
        for name, values in found.items()
    }


# The table joins reasons that are alike; the JSON keeps them apart.
_COLUMNS = {
    "no way": ("unreachable", "limits", "no-candidate", "not-reached"),
    "axis": ("reach-axis",),
    "lift": ("lift",),
    "touch": ("touch",),
    "hold": ("hold",),
    "self": ("self",),
    "arm": ("arm-table", "arm-object"),
    "table": ("hand-table",),
    "object": ("hand-object",),
}
_CAPTION = (
    "tried, and refused for: no inverse kinematics, candidate or end of the reach; an axis that "
    "the selection would not take; an arm that cannot lift straight up from there; a finger that "
    "cannot touch its contact; contacts at which the hand has not the force to hold it; a "
    "collision of the robot with itself, of the arm, of the hand with table or object. Feasible "
    "are the others, kept as many as were asked for, few of each drawn candidate."
)


def report_table(reports: Sequence[ObjectReport]) -> Table:
    """The per-object table that the command prints."""
    table = Table(title="Start states: pairs of object pose and candidate", box=SIMPLE, padding=0)
    table.caption, table.caption_justify = _CAPTION, "left"
    table.add_column("object", no_wrap=True)
    kinds = {r.kind for r in reports} - {"ik"}
    if kinds:
        table.add_column("kind")
    for column in ("tried", *_COLUMNS, "feasible", "kept", "s"):
        table.add_column(column, justify="right")
    for r in reports:
        table.add_row(
            r.name,
            *([r.kind] if kinds else []),
            str(r.sampled),
            *(str(sum(r.rejected[reason] for reason in group)) for group in _COLUMNS.values()),
            f"{100 * r.feasible_share:.0f} %",
            str(r.kept) if r.eligible else "not eligible",
            f"{r.seconds:.0f}",
        )
    return table


def read_report(path: Path) -> dict[str, Any]:
    """A report that `write_report` wrote.

    Raises:
        FileError: There is none, or it is damaged.
    """
    expected = "the report beside a handoff set"
    document = read_json(path, expected)
    rows, earlier = document.get("objects"), document.get("earlier", [])
    parts = {"name", "eligible"}
    whole = isinstance(rows, list) and all(isinstance(r, dict) and parts <= r.keys() for r in rows)
    if not whole or "provenance" not in document or not isinstance(earlier, list):
        raise FileError(path, f"the entries {', '.join(document)}", expected)
    return {"provenance": document["provenance"], "objects": rows, "earlier": earlier}


def write_report(
    path: Path,
    reports: Sequence[ObjectReport],
    provenance: dict[str, Any],
    config: dict[str, Any],
    earlier: Sequence[dict[str, Any]] = (),
) -> None:
    """Writes the reports, the settings and the run's facts as JSON, complete or not at all.

    Args:
        path: File to write.
        reports: One per object and kind.
        provenance: From `mjx_grasp.records.provenance.provenance`.
        config: The full configuration as JSON types.
        earlier: The reports of the sets that were updated; of an object that several have, the rows
            of the last stay.
    """
    rows = [report.as_row() for report in reports]
    document: dict[str, Any] = {"provenance": provenance, "config": config}
    for before in reversed(earlier):
        made = {row["name"] for row in rows}
        rows = [row for row in before["objects"] if row["name"] not in made] + rows
    if earlier:
        steps = [[*before["earlier"], before["provenance"]] for before in earlier]
        document["earlier"] = [step for each in steps for step in each]
    document["objects"] = rows
    have = {row["name"] for row in rows if row["eligible"]}
    document["not_eligible"] = list(dict.fromkeys(r["name"] for r in rows if r["name"] not in have))
    write_json(path, document)
