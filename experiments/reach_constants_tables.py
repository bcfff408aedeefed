"""What open constants make of the published controller's reaching, for the README."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown, read

from mjx_grasp.evaluation.reach.record import BUDGETS
from mjx_grasp.evaluation.reach.results import PAPER_HANDOFF_MM, PAPER_RATE
from mjx_grasp.records.table import Table

Row = Mapping[str, Any]
"""Of a sweep, as the results file has it."""
_TIPS = ("thumb", "index", "middle", "midpoint")


def rate(row: Row) -> float:
    """Reaches within 20 mm after 3 s, [%]."""
    return row["rate_percent"]["20"]["3"]


def name_of(changes: Mapping[str, Any]) -> str:
    """Changed constants in words; `paper` if there are none."""
    return (
        ", ".join(f"{_short(path)} {_shown(value)}" for path, value in changes.items()) or "paper"
    )


def _short(path: str) -> str:
    """The end of a path that tells constants apart."""
    return ".".join(path.split(".")[-2:])


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_shown, value)) + ")"
    return f"{float(value):.3g}".replace("-inf", "none")


def constants(path: Path) -> str:
    """What closes the gap to the publication, what does not, and why reaches still fail."""
    d = read(path)
    if d is None:
        return NOTHING
    *_, together = d["judged"]
    asked, paper = d["settings"], d["judged"][0]
    published = dict(zip(BUDGETS, PAPER_RATE["20"], strict=True))[3.0]
    halves = together["at_20mm_3s_percent_of"]
    where = ", ".join(f"{name} {share:.1f} %" for name, share in halves.items())
    return (
        f"Whole sweeps of {asked['poses']:,} poses. {name_of(together['changes'])} together bring "
        f"the reaches within 20 mm after 3 s from {rate(paper):.1f} to {rate(together):.1f} %; "
        f"the publication has {published:.1f} %:\n\n{markdown(judged_table(d))}\n\n"
        f"With them together, reaches had come up against something in the end, in %; several may "
        f"apply:\n\n{markdown(against_table(together))}\n\n"
        f"Of each half of the cylinders and of their places are reached: {where}.\n\n"
        f"<details><summary>One constant at a time, and together, on {asked['tuning_poses']} "
        f"poses of a tuning seed</summary>\n\n{markdown(tried_table(d))}\n\n</details>"
    )


def against_table(row: Row) -> Table:
    """What held up reaches that failed, beside those that did not."""
    found = row["against_percent_of"]
    things = list(next(iter(found.values())))
    rows = [
        (how, *("" if of[name] is None else f"{of[name]:.1f}" for name in things))
        for how, of in found.items()
    ]
    return Table("Came up against [%]", ("", *things), tuple(rows))


def judged_table(d: Row) -> Table:
    """Whole sweeps beside the published one."""
    budgets = [f"{b:g}" for b in (1.0, 3.0, 7.0)]
    header = (
        *("", *(f"20 mm, {b} s" for b in budgets), "10 mm, 3 s", "upright", "lying"),
        *("thumb mm", "index mm", "middle mm", "midpoint mm"),
        *("slow", "collision", "to object mm"),
    )
    rows = []
    for row in d["judged"]:
        rates, tips = row["rate_percent"], row["handoff_mm"]
        values = [rates["20"][b] for b in budgets] + [rates["10"]["3"]]
        values += [row["at_20mm_3s"][how] for how in ("upright", "lying")]
        values += [tips[name]["mean"] for name in _TIPS]
        values += [row["failures_percent"][why] for why in ("slow", "collision")]
        values += [row["limits"]["safe"]["least_object_distance_mm"]]
        rows.append((name_of(row["changes"]), *(f"{value:.1f}" for value in values)))
    of = {t: dict(zip(BUDGETS, PAPER_RATE[t], strict=True)) for t in ("20", "10")}
    values = [of["20"][float(b)] for b in budgets] + [of["10"][3.0]]
    tips = [PAPER_HANDOFF_MM[name][0] for name in _TIPS]
    cells = [f"{v:.1f}" for v in values], [f"{v:.1f}" for v in tips]
    rows.append(("published", *cells[0], "", "", *cells[1], "", "", ""))
    return Table("Reaches converged [%]", header, tuple(rows))


def tried_table(d: Row) -> Table:
    """What each constant does by itself, and what those that help do together."""
    header = ("", "paper", "20 mm, 3 s", "difference", "upright", "lying", "10 mm, 3 s")
    start = rate(d["tried"][0])
    first, *singles = d["tried"]
    rows = []
    for row in (first, *sorted(singles, key=rate, reverse=True), *d["combined"]):
        changes = row["changes"]
        values = [row["at_20mm_3s"][how] for how in ("upright", "lying")]
        values.append(row["rate_percent"]["10"]["3"])
        own = _shown(d["paper"][next(iter(changes))]) if len(changes) == 1 else ""
        shown = f"{rate(row):.1f}", f"{rate(row) - start:+.1f}", *(f"{v:.1f}" for v in values)
        rows.append((name_of(changes), own, *shown))
    return Table("Reaches converged [%]", header, tuple(rows), names=2)
