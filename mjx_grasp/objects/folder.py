"""The meshes that a path names: one file, or a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mjx_grasp.errors import FileError
from mjx_grasp.objects.meshes import EXTENSIONS, check_extension

_SCANS = ("nontextured.ply", "textured.obj")


class MeshFile(NamedTuple):
    """A mesh file and the name that its results get."""

    name: str
    path: Path


def find_meshes(path: str | Path) -> list[MeshFile]:
    """The mesh files that a path names, in alphabetical order.

    In a folder: its own mesh files, and the scans of an official YCB download
    (``NNN_name/google_16k/nontextured.ply``). Names are file names without the extension; where
    two would be called alike, with it.

    Raises:
        FileError: There is no such file or folder, it is no mesh, or there is none in it.
    """
    path = Path(path)
    kinds = ", ".join(EXTENSIONS)
    if path.is_file():
        check_extension(path)
        return [MeshFile(path.stem, path)]
    if not path.is_dir():
        raise FileError(path, "no such file or folder", f"a mesh ({kinds}) or a folder of meshes")
    entries = sorted(path.iterdir())
    flat = [e for e in entries if e.suffix.lower() in EXTENSIONS and e.is_file()]
    found = []
    for entry in entries:
        scans = [entry / "google_16k" / name for name in _SCANS]
        found += [MeshFile(entry.name, scan) for scan in scans if scan.is_file()][:1]
    names = [*(file.name for file in found), *(e.stem for e in flat)]
    found += [MeshFile(e.stem if names.count(e.stem) == 1 else e.name, e) for e in flat]
    if not found:
        raise FileError(path, "no meshes", f"files of {kinds}, or NAME/google_16k/{_SCANS[0]}")
    return sorted(found)
