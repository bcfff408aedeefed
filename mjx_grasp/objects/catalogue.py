"""The catalogue of objects."""
from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field

import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError


@dataclass(frozen=True)
class ObjectInfo:
    """An entry."""

    name: str
    ycb_id: str
    split: str
    mass: float
    published_dims_m: tuple[float, ...]
    shape: str
    the_eight: bool = False
    scale: float = 1.0
    parts: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def scan_names(self):
        base = self.name.removesuffix("_scaled")
        return (f"{self.ycb_id}_{base}",)


def load_catalogue() -> dict[str, ObjectInfo]:
    """All entries by name."""
    entries = yaml.safe_load(asset_path("catalogue.yaml").read_text())["objects"]
    return {
        e["name"]: ObjectInfo(e["name"], e["ycb_id"], e["split"], e["mass_g"] / 1000, tuple(x / 1000 for x in e["published_dims_mm"]), e["shape"], e["the_eight"], e.get("scale", 1.0))
        for e in entries
    }


def resolve(names: Sequence[str]) -> tuple[str, ...]:
    """Names and groups to names."""
    cat = load_catalogue()
    groups = {"eight": [n for n, e in cat.items() if e.the_eight], "train": [n for n, e in cat.items() if e.split == "train"], "held_out": [n for n, e in cat.items() if e.split == "held_out"], "all": list(cat)}
    out: list[str] = []
    for n in names:
        if n in groups:
            out += groups[n]
        elif n in cat:
            out.append(n)
        else:
            near = difflib.get_close_matches(n, [*groups, *cat])
            raise InputError("object", n, f"a name like {', '.join(near) or 'sugar_box'}")
    return tuple(dict.fromkeys(out))
