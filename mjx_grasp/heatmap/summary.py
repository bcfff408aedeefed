"""What a batch of heatmaps is summed up in: a row per mesh, triples as plain numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from mjx_grasp.heatmap.files import HeatmapInfo
from mjx_grasp.heatmap.sampling import Triples
from mjx_grasp.records.atomic import replacing, write_json

GOOD = 0.3
"""Rows count the candidates above this score."""
LEAST = 0.05
"""Score of what is a grasp at all; of one near a place, against the best of the place."""


@dataclass(frozen=True)
class Row:
    """One mesh; numbers are None where it failed."""

    name: str
    file: str
    vertices: int | None = None
    faces: int | None = None
    best_score: float | None = None
    share_above_0_3: float | None = None
    """Of the vertices."""
    seconds: float | None = None
    """Of the heatmap, without reading and pictures; the first of a kind holds compilation."""
    error: str = ""
    hint: str = ""
    """Why nothing can be grasped."""


def summary_table(rows: Sequence[Row]) -> Table:
    """The rows for a terminal."""
    table = Table()
    table.add_column("mesh")
    for title in ("vertices", "faces", "best score", f"above {GOOD} [%]", "seconds"):
        table.add_column(title, justify="right")
    for row in rows:
        if row.best_score is None or row.share_above_0_3 is None:
            table.add_row(escape(row.name), "", "", "failed", style="red")
            continue
        numbers = (f"{row.vertices}", f"{row.faces}", f"{row.best_score:.3f}")
        shares = f"{100 * row.share_above_0_3:.1f}", f"{row.seconds:.1f}"
        table.add_row(escape(row.name), *numbers, *shares)
    return table


def is_summary(path: Path) -> bool:
    """Whether a file is a table of such rows."""
    try:
        with path.open(newline="") as stream:
            return next(csv.reader(stream), None) == list(Row.__dataclass_fields__)
    except (OSError, UnicodeDecodeError, csv.Error):
        return False


def write_summary(
    folder: Path, rows: Sequence[Row], settings: dict[str, Any], provenance: dict[str, Any]
) -> None:
    """Writes ``summary.csv`` (the rows) and ``summary.json`` (with settings and provenance)."""
    with replacing(folder / "summary.csv") as temporary, temporary.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(Row.__dataclass_fields__))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    meshes = [asdict(row) for row in rows]
    content = {"meshes": meshes, "settings": settings, "provenance": provenance}
    write_json(folder / "summary.json", content)


def write_triples(path: Path, triples: Triples, info: HeatmapInfo) -> None:
    """Writes triples and how their heatmap was made as JSON; metres, frame of the mesh."""
    content = {"unit": "m", "frame": "mesh", **asdict(info), "triples": as_records(triples)}
    write_json(path, content)


def as_records(triples: Triples) -> list[dict[str, Any]]:
    """The valid triples as plain numbers, in their order."""
    rows = np.flatnonzero(np.asarray(triples.valid))
    fields = {name: np.asarray(value) for name, value in triples._asdict().items()}
    del fields["valid"]
    return [{name: value[k].tolist() for name, value in fields.items()} for k in rows]
