"""An object as simulation and heatmap need it, from a scan, its stand-in or a user's own mesh."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError
from mjx_grasp.objects.catalogue import (
    Asked,
    Part,
    catalogue_entry,
    find_objects,
    load_catalogue,
)
from mjx_grasp.objects.config import Weight
from mjx_grasp.objects.convex import ConvexConfig, Piece, convex_pieces
from mjx_grasp.objects.inertia import mass_properties
from mjx_grasp.objects.meshes import centred, find_scan, read_mesh
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.parts import parts_of
from mjx_grasp.objects.resting import RestingPose, resting_poses
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.provenance import usable_cores

GRAVITY = 9.81
"""[m/s²]"""
_CACHE_FORMAT = 3

Derived = tuple[tuple[Piece, ...], float]
"""Convex pieces and their outward error [m]."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Shape, mass and resting poses. Object frame: axis-aligned box centred at the origin, z up."""

    name: str
    source: str
    """'scan', 'parametric', or 'mesh' for a user's own."""
    mesh: trimesh.Trimesh
    """Closed, wound outwards [m]."""
    mass: float
    """kg, of the catalogue or as the user says."""
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
    parts: Mapping[str, Part] = field(default_factory=dict)
    """Named parts."""

    @property
    def weight(self) -> float:
        """[N]"""
        return GRAVITY * self.mass


def object_mesh(name: str, objects_dir: Path | None) -> trimesh.Trimesh:
    """The mesh of an object in its own frame [m]: a scan, a parametric stand-in or a user's mesh.

    Args:
        name: A name of the catalogue, or a mesh file.
        objects_dir: Folder of real scans; the stand-in without one.

    Raises:
        InputError: An unknown name.
        FileError: The scan or mesh is missing or unusable.
    """
    return _shape(_one(name), objects_dir)[0]


_HEAVIEST = 22_600.0  # kg/m³, the density of osmium


def _one(name: str) -> Asked:
    asked = find_objects(name, one=True)
    if len(asked) != 1:
        raise InputError("object", name, f"one of {', '.join(load_catalogue())}, or one mesh")
    return asked[0]


def _shape(asked: Asked, objects_dir: Path | None) -> tuple[trimesh.Trimesh, Mapping[str, Part]]:
    """Mesh and parts in the object frame [m]."""
    if asked.file is not None:
        mesh = read_mesh(asked.file.path)
        return centred(mesh), parts_of(asked.file, mesh)
    info = load_catalogue()[asked.name]
    if objects_dir is None:
        return stand_in(info.scan_of, info.scale), info.parts_on(scan=False)
    scan = read_mesh(find_scan(objects_dir, info.scan_names))
    return centred(scan, info.scale), info.parts


def load_object(
    name: str,
    objects_dir: Path | None = None,
    cache_dir: Path | None = None,
    weight: Weight | None = None,
) -> ObjectModel:
    """Loads an object; its convex pieces are computed once and cached.

    Args:
        name: A name of the catalogue, or a mesh file.
        objects_dir: Folder of real scans; the parametric stand-in without one.
        cache_dir: Where derived shapes are kept; ``~/.cache/mjx_grasp`` by default.
        weight: Of a mesh; by `DENSITY` if None.

    Raises:
        InputError: An unknown name.
        FileError: The scan or mesh, or the file of parts beside it, is missing or unusable.
    """
    asked = _one(name)
    mesh, parts = _shape(asked, objects_dir)
    mass, _ = _weighed(asked, mesh, weight or Weight())
    derived = _derived({asked.name: mesh}, cache_dir)[asked.name]
    return _model(asked, mesh, parts, derived, objects_dir, mass)


def load_objects(
    names: str | Sequence[str],
    objects_dir: Path | None = None,
    cache_dir: Path | None = None,
    weight: Weight | None = None,
) -> list[ObjectModel]:
    """Loads several objects, with a progress bar while shapes have to be worked out.

    Says what meshes of the user weigh, and which objects are collided with well outside their
    surface.

    Args:
        names: Names and groups of the catalogue, meshes and folders of meshes; or one of them.
        objects_dir, cache_dir: As of `load_object`.
        weight: Of each mesh; by `DENSITY` if None.

    Raises:
        InputError: An unknown name, two meshes of one name, or a weight without a mesh.
        FileError: A scan, a mesh or a file of parts is missing or unusable.
    """
    asked, weight = find_objects(names), weight or Weight()
    own = [each.name for each in asked if each.file is not None]
    if weight != Weight() and not own:
        found = ", ".join(each.name for each in asked)
        raise InputError(
            "--mass or --density", found, "a mesh: the catalogue's objects have masses"
        )
    by_name = {each.name: each for each in asked}
    shapes = {each.name: _shape(each, objects_dir) for each in asked}
    weighed = {name: _weighed(by_name[name], mesh, weight) for name, (mesh, _) in shapes.items()}
    console = Console(stderr=True)
    derived = _derived({name: mesh for name, (mesh, _) in shapes.items()}, cache_dir, console)
    loaded = [
        _model(each, *shapes[name], derived[name], objects_dir, weighed[name][0])
        for name, each in by_name.items()
    ]
    for obj in loaded:
        if obj.name in own:
            said = f"{obj.name}: {obj.mass:.3g} kg, {weighed[obj.name][1]}"
            console.print(said, markup=False, highlight=False)
    allowed = ConvexConfig().single_hull_error
    off = {o.name: 1e3 * o.outward_error_95 for o in loaded if o.outward_error_95 > allowed}
    if off:
        named = ", ".join(f"{name} ({error:.0f} mm)" for name, error in off.items())
        console.print(
            f"[yellow]convex pieces stand out by more than {1e3 * allowed:g} mm: {named}[/yellow]"
        )
    return loaded


def _model(
    asked: Asked,
    mesh: trimesh.Trimesh,
    parts: Mapping[str, Part],
    derived: Derived,
    objects_dir: Path | None,
    mass: float,
) -> ObjectModel:
    source = "mesh"
    if asked.file is None:
        source = "parametric" if objects_dir is None else "scan"
    com, inertia = mass_properties(mesh, mass)
    pieces, error = derived
    resting, digest = resting_poses(pieces, com), _content_hash(mesh)
    return ObjectModel(
        asked.name, source, mesh, mass, com, inertia, pieces, error, resting, digest, parts
    )


def _weighed(asked: Asked, mesh: trimesh.Trimesh, weight: Weight) -> tuple[float, str]:
    """The mass of an object [kg], and in words where it comes from.

    Raises:
        InputError: No matter is so heavy.
    """
    if asked.file is None:
        return load_catalogue()[asked.name].mass, "as in the catalogue"
    entry = catalogue_entry(asked.file.name)
    if entry is not None and weight == Weight():
        return entry.mass, f"as the catalogue's {entry.name}; --mass or --density says otherwise"
    mass, said = weight.of(mesh.volume)
    most = _HEAVIEST * mesh.convex_hull.volume
    if mass > most:
        field = "--density" if weight.mass is None else "--mass"
        expected = f"{most:.3g} kg at most, as if it were of osmium; units are kg and m"
        raise InputError(field, f"{mass:.3g} kg for {asked.name}", expected)
    return mass, said


def _derived(
    meshes: Mapping[str, trimesh.Trimesh], cache_dir: Path | None, console: Console | None = None
) -> dict[str, Derived]:
    """Convex pieces and their error by name: those of the cache, and the others on all cores.

    In threads: NumPy, SciPy and CoACD, which take the time, run beside each other in them.
    """
    entries = {name: _cache_entry(_content_hash(m), cache_dir) for name, m in meshes.items()}
    kept = {name: _read_cache(entry) for name, entry in entries.items()}
    known = {name: derived for name, derived in kept.items() if derived is not None}
    missing = [name for name in meshes if name not in known]
    if not missing:
        return known
    cores = usable_cores()
    pool = ThreadPoolExecutor(cores)
    with counting_progress(console, transient=True) as progress:
        bar = progress.add_task(_working_on(missing, cores), total=len(missing))
        futures = {pool.submit(convex_pieces, meshes[name]): name for name in missing}
        try:
            for done in as_completed(futures):
                name = futures[done]
                known[name] = done.result()
                with suppress(OSError):  # where nothing can be kept, it is worked out again
                    _write_cache(entries[name], *known[name])
                missing.remove(name)
                progress.update(bar, advance=1, description=_working_on(missing, cores))
        finally:
            # After Ctrl-C nothing new begins, and what cannot be stopped is not waited for.
            pool.shutdown(wait=False, cancel_futures=True)
    return known


def _working_on(names: Sequence[str], cores: int) -> str:
    """What the bar says: objects are begun in their order, one per core."""
    begun = names[:cores]
    others = f" and {len(begun) - 1} more" if len(begun) > 1 else ""
    return f"convex pieces of {begun[0]}{others}" if begun else "convex pieces"


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
