"""How near the tips of start states are to their goals, beside the publication's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.reach.results import PAPER_HANDOFF_MM
from mjx_grasp.handoff.report import TIPS, ObjectReport
from mjx_grasp.records.table import Table

_COLUMNS = (*TIPS, "tips")


def tip_error_table(reports: Sequence[ObjectReport]) -> Table:
    """Tip errors of reached states by object, mean / median, and the published mean of each.

    Objects count the same in the mean, whose published figure is of the same objects.

    Args:
        reports: Those of other kinds, and those without states, are left out.
    """
    shown = {r.name: r.tip_error_mm for r in reports if r.kind == "reached" and r.tip_error_mm}
    rows = [(name, *_cells(errors), _published([name])) for name, errors in shown.items()]
    mean = {
        tip: {k: float(np.mean([e[tip][k] for e in shown.values()])) for k in ("mean", "median")}
        for tip in (_COLUMNS if shown else ())
    }
    last = [("mean", *_cells(mean), _published(shown))] if shown else []
    at = tuple("{:.1f} ± {:.1f}".format(*PAPER_HANDOFF_MM[tip]) for tip in TIPS)
    last.append(("published, all", *at, "", ""))
    header = ("object", *_COLUMNS, "published")
    title = "Tip errors of reached start states, mm, mean / median; the three tips together: tips"
    return Table(title, header, (*rows, *last), summary=len(last))


def _cells(errors: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    return tuple(f"{errors[tip]['mean']:.1f} / {errors[tip]['median']:.1f}" for tip in _COLUMNS)


def _published(names: Sequence[str] | Mapping[str, object]) -> str:
    """The publication's mean over these objects, of those that it has."""
    known = [paper.OBJECTS[name].reach_mm[0] for name in names if name in paper.OBJECTS]
    return f"{np.mean(known):.1f}" if len(known) == len(names) else ""
