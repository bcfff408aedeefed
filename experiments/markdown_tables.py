"""How a table of the READMEs is written, and the results file that it is of is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

NOTHING = "_No results file yet._"


def markdown(table: Table) -> str:
    """A table without its title, as Markdown."""
    first = len(table.rows) - table.summary
    rule = ["---"] * table.names + ["---:"] * (len(table.header) - table.names)
    lines = [table.header, tuple(rule)]
    for i, row in enumerate(table.rows):
        lines.append(row if i < first else tuple(f"**{c}**" if c else "" for c in row))
    return "\n".join(f"| {' | '.join(c.replace('|', '/') for c in cells)} |" for cells in lines)


def read(path: Path) -> dict[str, Any] | None:
    """A results file; None where there is none."""
    return read_json(path, "a results file") if path.exists() else None


def short_revision(made: dict[str, Any]) -> str:
    """A provenance's revision, short; that it had uncommitted changes is not left out."""
    revision = str(made.get("git", ""))
    return revision[:12] + "-dirty" * revision.endswith("-dirty")
