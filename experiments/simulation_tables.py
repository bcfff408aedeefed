"""Tables of what simulation is made of, for the READMEs: the objects' convex pieces, the engines.

Each takes the path of one results file and gives Markdown; `make_readme.py` puts it in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown

from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table


def convex_pieces(path: Path) -> str:
    """How many objects one shape is enough for, then every object's pieces and errors."""
    if not path.exists():
        return NOTHING
    d = read_json(path, "a results file")
    rows, settings = d["rows"], d["settings"]
    asked = 1e3 * settings["single_hull_error"]
    first, *finer = (division["max_pieces"] for division in settings["divisions"])
    more = [f", {most} where these are off by more" for most in finer]
    allowed = f"{first} are allowed{''.join(more)}"
    kinds = {kind: sum(r["kind"] == kind for r in rows) for kind in ("sphere", "hull", "pieces")}
    beyond = [r for r in rows if r["outward_error_95_mm"] > asked]
    text = (
        f"Of {len(rows)} objects {kinds['sphere']} are spheres, {kinds['hull']} one hull (its "
        f"error is at most {asked:g} mm), {kinds['pieces']} coacd's pieces: at most "
        f"{max(r['pieces'] for r in rows)} ({allowed}), of at most "
        f"{max(r['most_vertices'] for r in rows)} vertices ({settings['max_vertices']})."
    )
    if beyond:
        names = ", ".join(_name(r) for r in beyond)
        text += f" With all their pieces these are still off by more than that: {names}."
    if d["without_scan"]:
        names = ", ".join(n.replace("_", " ") for n in d["without_scan"])
        text += f" Without a scan: {names}."
    return f"{text}\n\n{markdown(pieces_table(rows))}"


def pieces_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per object."""
    header = ("object", "kind", "pieces", "most vertices", "95 % outward mm", "one hull's mm")
    cells = tuple(
        (
            _name(r),
            r["kind"],
            str(r["pieces"]),
            str(r["most_vertices"]),
            f"{r['outward_error_95_mm']:.2f}",
            f"{r['hull_error_95_mm']:.2f}",
        )
        for r in rows
    )
    return Table("Convex pieces", header, cells, names=2)


def engines(path: Path) -> str:
    """Control steps per second of both engines on one device, and their ratio."""
    if not path.exists():
        return NOTHING
    d = read_json(path, "a results file")
    speed = {(r["worlds"], r["engine"]): r for r in d["rows"]}
    rows = []
    for worlds in dict.fromkeys(r["worlds"] for r in d["rows"]):
        mjx, native = speed[worlds, "mjx"], speed[worlds, "mujoco"]
        rows.append(
            (
                f"{worlds:,}",
                *(f"{r['control_steps_per_s']:,.0f}" for r in (mjx, native)),
                f"{native['control_steps_per_s'] / mjx['control_steps_per_s']:.0f} ×",
                *(f"{r['compile_and_first_run_s']:.0f}" for r in (mjx, native)),
                *(f"{r['slowest_over_fastest']:.2f}" for r in (mjx, native)),
            )
        )
    header = (
        *("worlds", "MJX steps/s", "native MuJoCo steps/s", "native / MJX"),
        *(
            "MJX compiles s",
            "native compiles s",
            "MJX slowest / fastest",
            "native slowest / fastest",
        ),
    )
    objects = ", ".join(name.replace("_", " ") for name in d["objects"])
    return (
        f"On {d['provenance']['device']}, with {objects}, {d['substeps']} physics steps per "
        "control step; compiling holds one run, slowest and fastest are of the "
        f"{d['settings']['repeats']} timed:\n\n{markdown(Table('Engines', header, tuple(rows)))}"
    )


def _name(row: dict[str, Any]) -> str:
    return str(row["object"]).replace("_", " ")
