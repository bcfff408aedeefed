"""How each object is divided into convex pieces, and how far these lie outside its scan.

Beside the pieces' own 95 % outward error stands that of one hull of the whole scan, which decides
whether the hull is enough. Objects without a scan are listed apart.

  python experiments/convex_pieces.py --objects-dir SCANS --out FILE.json
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.progress import track
from scans import has_scan
from simulation_tables import pieces_table

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.convex import ConvexConfig, single_hull
from mjx_grasp.objects.model import ObjectModel, load_object
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings

SCHEMA = "mjx_grasp.convex_pieces/1"


@dataclass(frozen=True)
class PiecesConfig(CommandSettings):
    """What to divide."""

    out: Path
    """results file to write (.json)"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    objects: tuple[str, ...] = ("all",)
    cache_dir: Path | None = None
    """where pieces are kept; ~/.cache/mjx_grasp by default"""


def divided(model: ObjectModel) -> dict[str, Any]:
    """The row of one object; errors in mm."""
    pieces, error = model.pieces, model.outward_error_95
    kind = pieces[0].kind if len(pieces) == 1 else "pieces"
    hull_error = error if kind == "hull" else single_hull(model.mesh)[1]
    return {
        "object": model.name,
        "kind": kind,
        "pieces": len(pieces),
        "most_vertices": max(len(piece.vertices) for piece in pieces),
        "outward_error_95_mm": round(1e3 * error, 3),
        "hull_error_95_mm": round(1e3 * hull_error, 3),
    }


def split_by_scan(names: tuple[str, ...], objects_dir: Path) -> tuple[list[str], list[str]]:
    """Objects that the folder holds a scan of, and the others.

    Raises:
        FileError: It holds none.
    """
    with_scan = [name for name in names if has_scan(name, objects_dir)]
    if not with_scan:
        raise FileError(objects_dir, "no scan of these objects", "a folder of object scans")
    return with_scan, [name for name in names if name not in with_scan]


def main(config: PiecesConfig) -> None:
    """Divides, writes the file after each object, prints the table."""
    names, without = list(resolve(config.objects)), []
    if config.objects_dir is not None:
        names, without = split_by_scan(tuple(names), config.objects_dir)
    settings = ConvexConfig()
    document = {
        "schema": SCHEMA,
        "provenance": provenance(settings.seed),
        "source": "parametric" if config.objects_dir is None else "scan",
        "settings": asdict(settings),
        "without_scan": without,
    }
    rows: list[dict[str, Any]] = []
    for name in track(names, "dividing", console=Console(stderr=True), transient=True):
        rows.append(divided(load_object(name, config.objects_dir, config.cache_dir)))
        write_json(config.out, document | {"rows": rows})
    Console().print(pieces_table(rows))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PiecesConfig, description=__doc__)))
