"""The catalogue, what is known of each object apart from its shape, and what else can be named."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.objects.folder import MeshFile, find_meshes
from mjx_grasp.objects.meshes import EXTENSIONS

SPLITS = ("train", "held_out", "figure_only", "scaled")
Point = tuple[float, float, float]


class Part(NamedTuple):
    """A named part of an object: a box along the object's axes, or a point if it has no size."""

    at: Point
    """its centre, object frame [m]"""
    size: Point = (0.0, 0.0, 0.0)
    """its edges [m]"""


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
    parts: Mapping[str, Part] = field(default_factory=dict)
    """Named parts of its scan."""
    stand_in_parts: Mapping[str, Part] = field(default_factory=dict)
    """Those of its stand-in, where they are elsewhere: all of them, or none."""

    def parts_on(self, scan: bool) -> Mapping[str, Part]:
        """Named parts of its scan or of its stand-in."""
        return self.parts if scan or not self.stand_in_parts else self.stand_in_parts

    @property
    def scan_names(self) -> tuple[str, ...]:
        """Stems of its scan in a folder of scans."""
        return (f"{self.ycb_id}_{self.scan_of}",)


class Asked(NamedTuple):
    """An object that was asked for."""

    name: str
    """Of the catalogue; of a user's mesh its file's name with the extension, which no object of the
    catalogue has."""
    file: MeshFile | None = None
    """The user's mesh; None for an object of the catalogue."""


def load_catalogue() -> dict[str, ObjectInfo]:
    """All entries by name, in the catalogue's order.

    Raises:
        FileError: The catalogue is damaged.
    """
    path = asset_path("catalogue.yaml")
    return dict(_catalogue(path, path.read_bytes()))


@lru_cache(maxsize=4)  # commands ask many times, and parsing is slow
def _catalogue(path: Path, content: bytes) -> dict[str, ObjectInfo]:
    try:
        entries = [_entry(e) for e in yaml.safe_load(content)["objects"]]
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


def resolve(names: str | Sequence[str]) -> tuple[str, ...]:
    """The names of the objects that are asked for, see `find_objects`."""
    return tuple(each.name for each in find_objects(names))


def find_objects(asked: str | Sequence[str], one: bool = False) -> tuple[Asked, ...]:
    """Names and groups of the catalogue, meshes and folders of meshes as objects.

    Each comes once, in the order given.

    Args:
        asked: One of these, or several.
        one: Whether a single object is wanted, so that no group is suggested for a wrong name.

    Raises:
        InputError: Nothing is asked for, something that is none of these, or two meshes of a name.
        FileError: A path leads to no mesh.
    """
    known, sets = load_catalogue(), groups()
    asked = [asked] if isinstance(asked, str) else asked
    found: dict[str, Asked] = {}
    for name in asked:
        if name in known or name in sets:
            found |= {member: Asked(member) for member in sets.get(name, (name,))}
        elif _is_path(name):
            for file in find_meshes(name):
                new = Asked(_mesh_name(file), file)
                other = found.setdefault(new.name, new).file
                if other is not None and other.path.resolve() != file.path.resolve():
                    both = f"{other.path}, {file.path}"
                    raise InputError("objects", both, "meshes of different names")
        else:
            near = difflib.get_close_matches(name, [*known] if one else [*sets, *known], 3, 0.5)
            names = f"{', '.join(near)}?" if near else "mug, apple, …"
            if not (near or one):
                names += f"; where several objects may be given, also {', '.join(sets)}"
            raise InputError("object", name, f"a mesh's path or a name of the catalogue: {names}")
    if not found:
        raise InputError("objects", list(asked), "one or more names, groups or meshes")
    return tuple(found.values())


def catalogue_entry(name: str) -> ObjectInfo | None:
    """The catalogue's entry whose scan has this name, for example ``025_mug``; None if unknown."""
    for info in load_catalogue().values():
        if name in info.scan_names and info.scale == 1.0:
            return info
    return None


def _is_path(text: str) -> bool:
    path = Path(text)
    with suppress(OSError):  # a name that no file can have
        if path.exists():
            return True
    return path.suffix.lower() in EXTENSIONS or "/" in text or os.sep in text


def _mesh_name(file: MeshFile) -> str:
    extension = file.path.suffix
    return file.name if file.name.endswith(extension) else file.name + extension


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
        parts=_parts(e.get("parts", {})),
        stand_in_parts=_parts(e.get("stand_in_parts", {})),
    )


def _parts(content: Mapping[str, Any]) -> dict[str, Part]:
    return {name: part_of(said) for name, said in content.items()}


def part_of(said: Any) -> Part:
    """A part as files say it: ``[x, y, z]``, or ``{at: [x, y, z], size: [x, y, z]}``, in metres.

    Raises:
        ValueError, TypeError: It is neither.
    """
    fields = dict(said) if isinstance(said, Mapping) else {"at": said}
    part = Part(**{name: _point(*value) for name, value in fields.items()})
    if not np.isfinite(part).all() or min(part.size) < 0:
        raise ValueError(f"a part {said}")
    return part


def _point(x: float, y: float, z: float) -> Point:
    if any(isinstance(value, str | bool) for value in (x, y, z)):
        raise TypeError("no numbers")
    return float(x), float(y), float(z)
