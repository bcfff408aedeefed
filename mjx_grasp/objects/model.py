"""An object as simulation and heatmap need it, from a scan or from its stand-in."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError
from mjx_grasp.objects.catalogue import ObjectInfo, load_catalogue
from mjx_grasp.objects.convex import ConvexConfig, Piece, convex_pieces
from mjx_grasp.objects.inertia import mass_properties
from mjx_grasp.objects.meshes import centred, find_scan, read_mesh
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.resting import RestingPose, resting_poses
from mjx_grasp.records.atomic import replacing

_CACHE_FORMAT = 3


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Shape, mass and resting poses. Object frame: axis-aligned box centred at the origin, z up."""

    name: str
    source: str
    """'scan' or 'parametric'."""
    mesh: trimesh.Trimesh
    """Closed, wound outwards [m]."""
    mass: float
    """kg, of the catalogue."""
    com: Float[np.ndarray, "3"]
    """Centre of mass at uniform density [m]."""
    inertia: Float[np.ndarray, "3 3"]
    """About the centre of mass, object axes [kg m²]."""
    pieces: tuple[Piece, ...]
    """Convex pieces for collision."""
    outward_error_95: float
    """95th percentile of how far the pieces' surface lies outside the mesh [m]."""
    resting: tuple[RestingPose, ...]
    """Stable poses on the table, the most probable first."""
    content_hash: str
    """SHA-256 of the mesh in whole micrometres; handoff states belong to one."""


def object_mesh(name: str, objects_dir: Path | None) -> trimesh.Trimesh:
    """The mesh of an object in its own frame [m]: its scan, or the parametric stand-in.

    Args:
        name: A name of the catalogue.
        objects_dir: Folder of real scans; the stand-in without one.

    Raises:
        InputError: An unknown name.
        FileError: The scan is missing or unusable.
    """
    info = _info(name)
    if objects_dir is None:
        return stand_in(info.scan_of, info.scale)
    return centred(read_mesh(find_scan(objects_dir, info.scan_names)), info.scale)


def _info(name: str) -> ObjectInfo:
    catalogue = load_catalogue()
    if name not in catalogue:
        raise InputError("object", name, f"one of {', '.join(catalogue)}")
    return catalogue[name]


def load_object(
    name: str, objects_dir: Path | None = None, cache_dir: Path | None = None
) -> ObjectModel:
    """Loads an object; its convex pieces are computed once and cached.

    Args:
        name: A name of the catalogue.
        objects_dir: Folder of real scans; the parametric stand-in without one.
        cache_dir: Where derived shapes are kept; ``~/.cache/mjx_grasp`` by default.

    Raises:
        InputError: An unknown name.
        FileError: The scan is missing or unusable.
    """
    mesh = object_mesh(name, objects_dir)
    mass = _info(name).mass
    com, inertia = mass_properties(mesh, mass)
    digest = _content_hash(mesh)
    entry = _cache_entry(digest, cache_dir)
    derived = _read_cache(entry)
    if derived is None:
        derived = convex_pieces(mesh)
        _write_cache(entry, *derived)
    pieces, error = derived
    resting = resting_poses(pieces, com)
    source = "parametric" if objects_dir is None else "scan"
    return ObjectModel(name, source, mesh, mass, com, inertia, pieces, error, resting, digest)


def load_objects(
    names: Sequence[str], objects_dir: Path | None = None, cache_dir: Path | None = None
) -> list[ObjectModel]:
    """Loads several objects, with a progress bar while shapes have to be worked out.

    Says which of them are collided with well outside their surface.
    """
    meshes = (object_mesh(n, objects_dir) for n in names)
    missing = sum(not _cache_entry(_content_hash(m), cache_dir).exists() for m in meshes)
    console = Console(stderr=True)
    with counting_progress(console if missing else None, transient=True) as progress:
        bar = progress.add_task("convex pieces", total=len(names))
        loaded = []
        for name in names:
            loaded.append(load_object(name, objects_dir, cache_dir))
            progress.advance(bar)
    allowed = ConvexConfig().single_hull_error
    off = {o.name: 1e3 * o.outward_error_95 for o in loaded if o.outward_error_95 > allowed}
    if off:
        named = ", ".join(f"{name} ({error:.0f} mm)" for name, error in off.items())
        console.print(
            f"[yellow]convex pieces stand out by more than {1e3 * allowed:g} mm: {named}[/yellow]"
        )
    return loaded


def stand_in_hash(name: str) -> str:
    """The content hash that the parametric stand-in of an object has.

    Args:
        name: A name of the catalogue.
    """
    return _content_hash(object_mesh(name, None))


def _content_hash(mesh: trimesh.Trimesh) -> str:
    micrometres = np.round(np.asarray(mesh.vertices) * 1e6).astype(np.int64)
    faces = np.asarray(mesh.faces, np.int64)
    return hashlib.sha256(micrometres.tobytes() + faces.tobytes()).hexdigest()


def _cache_entry(digest: str, cache_dir: Path | None) -> Path:
    folder = cache_dir or Path.home() / ".cache" / "mjx_grasp"
    settings: dict[str, Any] = {
        "format": _CACHE_FORMAT,
        "convex": asdict(ConvexConfig()),
    }
    key = hashlib.sha256((digest + json.dumps(settings, sort_keys=True)).encode()).hexdigest()
    return folder / f"{key[:32]}.npz"


def _write_cache(path: Path, pieces: tuple[Piece, ...], error: float) -> None:
    arrays: dict[str, Any] = {f"vertices_{i}": p.vertices for i, p in enumerate(pieces)}
    arrays |= {
        "kind": np.array([p.kind for p in pieces]),
        "pos": np.stack([p.pos for p in pieces]),
        "radius": np.array([p.radius for p in pieces]),
        "error": np.array(error),
    }
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def _read_cache(path: Path) -> tuple[tuple[Piece, ...], float] | None:
    """A cache entry; None where there is none or it is damaged, so that it is made again."""
    if not path.exists():
        return None
    try:
        with np.load(path) as a:
            pieces = tuple(
                Piece(str(kind), a["pos"][i], float(a["radius"][i]), a[f"vertices_{i}"])
                for i, kind in enumerate(a["kind"])
            )
            return pieces, float(a["error"])
    except Exception:
        return None
