"""The catalogue: what is known of each object apart from its shape."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError

SPLITS = ("train", "held_out", "figure_only", "scaled")
Point = tuple[float, float, float]


@dataclass(frozen=True)
class ObjectInfo:
    """An entry of the catalogue."""

    name: str
    ycb_id: str
    split: str
    """'train', 'held_out' (never trained or tuned on), 'figure_only', or 'scaled' for a copy."""
    mass: float
    """kg."""
    published_dims_m: tuple[float, ...]
    shape: str
    the_eight: bool = False
    """Whether it is one of the paper's eight objects."""
    scale: float = 1.0
    """Uniform scale on scan and stand-in."""
    scan_of: str = ""
    """The object whose scan it uses; its own name unless it is a scaled copy."""
    parts: Mapping[str, Point] = field(default_factory=dict)
    """Named parts: centre points in the object frame [m]."""

    @property
    def scan_names(self) -> tuple[str, ...]:
        """Stems of its scan in a folder of scans."""
        return (f"{self.ycb_id}_{self.scan_of}",)


def load_catalogue() -> dict[str, ObjectInfo]:
    """All entries by name, in the catalogue's order.

    Raises:
        FileError: The catalogue is damaged.
    """
    path = asset_path("catalogue.yaml")
    try:
        entries = [_entry(e) for e in yaml.safe_load(path.read_text())["objects"]]
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"a damaged catalogue ({error!r})", "a list of objects") from None
    catalogue = {e.name: e for e in entries}
    if len(catalogue) != len(entries):
        raise FileError(path, "a name twice", "every name once")
    return catalogue


def groups() -> dict[str, tuple[str, ...]]:
    """The groups that `resolve` knows, and their members."""
    entries = load_catalogue().values()
    return {
        "eight": tuple(e.name for e in entries if e.the_eight),
        "train": tuple(e.name for e in entries if e.split == "train"),
        "held_out": tuple(e.name for e in entries if e.split == "held_out"),
        "all": tuple(e.name for e in entries),
    }


def resolve(names: Sequence[str]) -> tuple[str, ...]:
    """Object names and groups as object names, each once, in the order given.

    Raises:
        InputError: No name, or one that is neither an object nor a group.
    """
    known, sets = load_catalogue(), groups()
    found: list[str] = []
    for name in names:
        if name in sets:
            found += sets[name]
        elif name in known:
            found.append(name)
        else:
            near = difflib.get_close_matches(name, [*sets, *known], n=3, cutoff=0.5)
            hint = f"{', '.join(near)}?" if near else f"{', '.join(sets)} or an object's name"
            raise InputError("object", name, f"a name of the catalogue: {hint}")
    if not found:
        raise InputError("objects", list(names), "one or more names or groups")
    return tuple(dict.fromkeys(found))


def _entry(e: Mapping[str, Any]) -> ObjectInfo:
    if e["split"] not in SPLITS or not e["mass_g"] > 0:
        raise ValueError(f"{e['name']}: split {e['split']!r}, mass {e['mass_g']} g")
    return ObjectInfo(
        name=e["name"],
        ycb_id=e["ycb_id"],
        split=e["split"],
        mass=1e-3 * e["mass_g"],
        published_dims_m=tuple(1e-3 * x for x in e["published_dims_mm"]),
        shape=e["shape"],
        the_eight=e.get("the_eight", False),
        scale=e.get("scale", 1.0),
        scan_of=e.get("scan_of", e["name"]),
        parts={name: _point(*centre) for name, centre in e.get("parts", {}).items()},
    )


def _point(x: float, y: float, z: float) -> Point:
    return float(x), float(y), float(z)
