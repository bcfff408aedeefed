"""Success and force over what differs from the model; `make_readme.py` puts the table in place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown, read
from paper_tables import cell_text, summed

from mjx_grasp.records.table import Table

FACTORS = {
    "friction": ("sliding friction", "{:g}"),
    "mass": ("object's mass", "{:g} ×"),
    "stiffness": ("finger stiffness", "{:g} ×"),
    "torque": ("torque limit", "{:g} ×"),
}
"""What each is called, and its values."""

Curve = dict[float, dict[str, Any]]


def curves(content: dict[str, Any]) -> dict[str, dict[str, Curve]]:
    """Of each controller and each factor that was run, success and force over its values.

    The nominal trials are part of every curve.
    """
    found: dict[str, dict[str, Curve]] = {}
    for name, parts in content["controllers"].items():
        (nominal,) = summed(parts["nominal"], ()).values()
        for factor, usual in content["nominal"].items():
            if factor in parts:
                cells = {x: cell for (x,), cell in summed(parts[factor], ("value",)).items()}
                curve = dict(sorted(({usual: nominal} | cells).items(), key=lambda at: at[0]))
                found.setdefault(name, {})[factor] = curve
    return found


def sensitivity(path: Path) -> str:
    """One line per changed value, one column per controller."""
    content = read(path)
    if content is None:
        return NOTHING
    found = curves(content)
    lines = []
    for factor, (called, shown) in FACTORS.items():
        values = {x for of in found.values() for x in of.get(factor, {})}
        for x in sorted(values):
            cells = (of.get(factor, {}).get(x) for of in found.values())
            texts = (cell_text(cell) if cell else "" for cell in cells)  # not run yet
            mark = " (nominal)" if x == content["nominal"][factor] else ""
            lines.append((called, shown.format(x) + mark, *texts))
    return markdown(Table("Sensitivity", ("what", "value", *found), tuple(lines), names=2))


def drawn_stiffness(path: Path, fixed: Path) -> str:
    """Over the finger stiffness: the policy, one whose training did not draw it, and the grip.

    Args:
        path: The table's file.
        fixed: The other policy's, of the same trials.
    """
    usual, other = read(path), read(fixed)
    if usual is None or other is None:
        return NOTHING
    shipped, before = curves(usual), curves(other)
    columns = {
        **{f"{name}, as shipped": of for name, of in shipped.items() if "policy" in name},
        **{f"{name}, stiffness fixed": of for name, of in before.items() if "policy" in name},
        "grip": shipped["grip"],
    }
    called, shown = FACTORS["stiffness"]
    lines = tuple(
        (shown.format(x), *(cell_text(of["stiffness"][x]) for of in columns.values()))
        for x in columns["grip"]["stiffness"]
    )
    return markdown(Table("Drawn stiffness", (called, *columns), lines))
