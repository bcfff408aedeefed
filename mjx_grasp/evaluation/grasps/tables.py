"""Whole grasps as a table: how many are held, how soon, and where the others failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from mjx_grasp.evaluation.grasps.results import OUTCOMES


def scenario_table(scenarios: Mapping[str, Mapping[str, Any]]) -> Table:
    """One row per scenario.

    Args:
        scenarios: As the results file has them.
    """
    table = Table(title="Whole grasps from home", box=None)
    table.add_column("scenario", no_wrap=True)
    for name in ("trials", "held %", "lifted s", "force N", "up 9 s %"):
        table.add_column(name, justify="right")
    table.add_column("otherwise")
    for name, result in scenarios.items():
        sums = result["all"]
        up = 100.0 * sums["up_at_9s"] / sums["trials"]
        cells = (sums["success_percent"], sums["lifted_s"], sums["force_mean_n"], up)
        known = ("-" if cell is None else f"{cell:.1f}" for cell in cells)
        failed = [f"{sums[name]} {name.replace('_', ' ')}" for name in OUTCOMES[1:] if sums[name]]
        table.add_row(name, str(sums["trials"]), *known, ", ".join(failed))
    return table
