"""Meshes of files: which are read, where scans are, and the object frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from mjx_grasp.errors import FileError
from mjx_grasp.objects.repair import repair

EXTENSIONS = (".obj", ".ply", ".stl", ".glb", ".off")


def read_mesh(path: str | Path) -> trimesh.Trimesh:
    """Reads a mesh in metres and repairs it to a closed surface with outward winding.

    Args:
        path: An .obj, .ply, .stl, .glb or .off file. The y axis of a .glb points up by its standard
            and becomes z; in the others z does.

    Raises:
        FileError: The file is missing, of another kind, not readable, empty, not finite, in the
            wrong unit (an extent outside 5 mm to 1 m) or open beyond repair.
    """
    path = Path(path)
    check_extension(path)
    if not path.is_file():
        raise FileError(path, "no such file", "a triangle mesh in metres")
    try:
        loaded = trimesh.load_mesh(str(path), process=False, skip_materials=True)
        vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # the loaders raise whatever their parsing meets
        raise FileError(
            path, f"nothing readable ({type(error).__name__}: {error})", "a triangle mesh"
        ) from error
    if path.suffix.lower() == ".glb":
        x, y, z = vertices.T
        vertices = np.stack([x, -z, y], axis=1)
    return repair(vertices, faces, path)


def check_extension(path: Path) -> None:
    """Makes sure that a file's name ends as that of a mesh.

    Raises:
        FileError: It does not, or it is a folder's.
    """
    if path.suffix.lower() not in EXTENSIONS:
        found = f"extension {path.suffix!r}" if path.suffix else "no extension"
        found = "a folder" if path.is_dir() else found
        raise FileError(path, found, f"a mesh: one of {', '.join(EXTENSIONS)}")


def centred(mesh: trimesh.Trimesh, scale: float = 1.0) -> trimesh.Trimesh:
    """The mesh scaled and moved to the object frame: axis-aligned box centred at the origin."""
    centre = mesh.bounds.mean(axis=0)
    return trimesh.Trimesh((mesh.vertices - centre) * scale, mesh.faces, process=False)


def find_scan(objects_dir: str | Path, names: Sequence[str]) -> Path:
    """The scan of an object in a folder: flat (``NNN_name.obj``) or as the official download.

    The official layout is ``NNN_name/google_16k/nontextured.ply`` or ``textured.obj``, below the
    folder itself or below a ``ycb`` folder in it.

    Args:
        objects_dir: The folder.
        names: Stems to look for, for example ``("004_sugar_box",)``, best first.

    Raises:
        FileError: The folder is missing or holds no such scan.
    """
    folder = Path(objects_dir)
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "a folder of object scans")
    for root in (folder, folder / "ycb"):
        for name in names:
            flat = [root / f"{name}{extension}" for extension in EXTENSIONS]
            scan = root / name / "google_16k"
            for candidate in (*flat, scan / "nontextured.ply", scan / "textured.obj"):
                if candidate.is_file():
                    return candidate
    wanted = " or ".join(names)
    raise FileError(
        folder, f"no scan of {wanted}", f"{names[0]}.obj or {names[0]}/google_16k/nontextured.ply"
    )
