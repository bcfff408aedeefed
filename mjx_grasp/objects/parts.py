"""Named parts of a mesh: from a file beside it, or of the scan that the catalogue knows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import trimesh
import yaml

from mjx_grasp.errors import FileError
from mjx_grasp.objects.catalogue import Part, catalogue_entry, part_of
from mjx_grasp.objects.folder import MeshFile
from mjx_grasp.records.strict_yaml import load_yaml

_FORMAT = (
    "parts: {NAME: [x, y, z] or {at: [x, y, z], size: [x, y, z]}, ...}, names of one lower-case "
    "word, metres"
)
_UNREADABLE = OSError, yaml.YAMLError, AttributeError, TypeError, ValueError, RecursionError
_BEYOND = 0.1  # a part farther from the mesh's box than this share of its diagonal is a mistake


def parts_of(file: MeshFile, mesh: trimesh.Trimesh) -> dict[str, Part]:
    """The parts of a mesh: those of the YAML file of the same name beside it.

    Without such a file a mesh that is called like a scan (``025_mug``) has the catalogue's parts,
    and any other has none.

    Args:
        file: Name and path of the mesh.
        mesh: As the file has it [m]; the file of parts has its points in that frame.

    Returns:
        Parts relative to the middle of the mesh's bounding box, as in the catalogue.

    Raises:
        FileError: The file of parts is not of this form, or a part is not at the mesh.
    """
    path = file.path.with_suffix(".yaml")
    if not path.is_file():
        entry = catalogue_entry(file.name)
        return {} if entry is None else dict(entry.parts)
    low, high = np.asarray(mesh.bounds)
    margin = _BEYOND * float(np.linalg.norm(high - low))
    middle = 0.5 * (low + high)
    parts = {}
    for name, part in _read(path).items():
        point = np.array(part.at)
        if (point < low - margin).any() or (point > high + margin).any():
            box = " to ".join(str(np.round(corner, 3).tolist()) for corner in (low, high))
            expected = f"a point [m] at {file.path.name}, which lies within {box}"
            raise FileError(path, f"{name} at {point.tolist()}", expected)
        if (np.array(part.size) > high - low + margin).any():
            expected = f"at most that of {file.path.name}, {np.round(high - low, 3).tolist()} m"
            raise FileError(path, f"{name} of size {list(part.size)}", expected)
        x, y, z = (point - middle).tolist()
        parts[name] = part._replace(at=(x, y, z))
    return parts


def _read(path: Path) -> dict[str, Part]:
    """Parts by name, in the frame of the mesh's file."""
    try:
        content = load_yaml(path.read_text())
        if set(content) != {"parts"}:
            raise ValueError(f"fields {', '.join(map(str, content))}")
        parts = {}
        for name, said in content["parts"].items():
            if not re.fullmatch("[a-z]+", name):
                raise ValueError(f"part {name!r}")
            try:
                parts[name] = part_of(said)
            except (TypeError, ValueError):
                raise ValueError(f"part {name!r}: {said}") from None
    except _UNREADABLE as error:
        said = " ".join(str(error).split())
        raise FileError(path, f"no parts that can be read ({said})", _FORMAT) from None
    return parts
