"""An object as simulation and heatmap need it, from a scan, its stand-in or a user's own mesh."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from rich.console import Console

from mjx_grasp.errors import InputError
from mjx_grasp.objects.catalogue import (
    Asked,
    Part,
    catalogue_entry,
    find_objects,
    load_catalogue,
)
from mjx_grasp.objects.config import Weight
from mjx_grasp.objects.convex import ConvexConfig, Piece
from mjx_grasp.objects.inertia import mass_properties
from mjx_grasp.objects.kept_pieces import Derived, content_hash, pieces_of
from mjx_grasp.objects.meshes import centred, find_scan, read_mesh
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.parts import parts_of
from mjx_grasp.objects.resting import RestingPose, resting_poses

GRAVITY = 9.81
"""[m/s²]"""


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


class Shape(NamedTuple):
    """What an object looks like, before anything is worked out from it; object frame."""

    name: str
    mesh: trimesh.Trimesh
    """[m]"""
    parts: Mapping[str, Part]
    """Named parts."""


def object_mesh(name: str, objects_dir: Path | None) -> trimesh.Trimesh:
    """The mesh of an object in its own frame [m]: a scan, a parametric stand-in or a user's mesh.

    Arguments and errors are those of `object_shape`.
    """
    return object_shape(name, objects_dir).mesh


def object_shape(name: str, objects_dir: Path | None) -> Shape:
    """The mesh of an object, and its parts, without what takes long to work out.

    Args:
        name: A name of the catalogue, or a mesh file.
        objects_dir: Folder of real scans; the stand-in without one.

    Raises:
        InputError: An unknown name.
        FileError: The scan or mesh, or the file of parts beside it, is missing or unusable.
    """
    asked = _one(name)
    return Shape(asked.name, *_shape(asked, objects_dir))


_HEAVIEST, _LIGHTEST = 22_600.0, 1.2  # kg/m³, the densities of osmium and of air


def _one(name: str | Path) -> Asked:
    asked = find_objects(os.fspath(name), one=True)
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
    name: str | Path,
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
        InputError: An unknown name, or a weight without a mesh.
        FileError: The scan or mesh, or the file of parts beside it, is missing or unusable.
    """
    asked = _one(name)
    _check_weight(weight, [asked])
    mesh, parts = _shape(asked, objects_dir)
    mass, _ = _weighed(asked, mesh, weight or Weight())
    derived = pieces_of({asked.name: mesh}, cache_dir)[asked.name]
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
    _check_weight(weight, asked)
    by_name = {each.name: each for each in asked}
    shapes = {each.name: _shape(each, objects_dir) for each in asked}
    weighed = {name: _weighed(by_name[name], mesh, weight) for name, (mesh, _) in shapes.items()}
    console = Console(stderr=True)
    derived = pieces_of({name: mesh for name, (mesh, _) in shapes.items()}, cache_dir, console)
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


def _check_weight(weight: Weight | None, asked: Sequence[Asked]) -> None:
    """Refuses a weight where there is no mesh that it could be of."""
    if weight not in (None, Weight()) and all(each.file is None for each in asked):
        found = ", ".join(each.name for each in asked)
        expected = "a mesh: the catalogue's objects have masses"
        raise InputError("--mass or --density", found, expected)


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
    resting, digest = resting_poses(pieces, com), content_hash(mesh)
    return ObjectModel(
        asked.name, source, mesh, mass, com, inertia, pieces, error, resting, digest, parts
    )


def _weighed(asked: Asked, mesh: trimesh.Trimesh, weight: Weight) -> tuple[float, str]:
    """The mass of an object [kg], and in words where it comes from.

    Raises:
        InputError: No matter is so heavy, or none that lies on a table so light.
    """
    if asked.file is None:
        return load_catalogue()[asked.name].mass, "as in the catalogue"
    entry = catalogue_entry(asked.file.name)
    if entry is not None and weight == Weight():
        return entry.mass, f"as the catalogue's {entry.name}; --mass or --density says otherwise"
    mass, said = weight.of(mesh.volume)
    most = _HEAVIEST * mesh.convex_hull.volume
    least = _LIGHTEST * mesh.volume
    if not least <= mass <= most:
        field = "--density" if weight.mass is None else "--mass"
        bound = f"{most:.3g} kg at most, as if it were of osmium"
        if mass < least:
            bound = f"{least:.3g} kg at least, what the air weighs in its place"
        raise InputError(field, f"{mass:.3g} kg for {asked.name}", f"{bound}; units are kg and m")
    return mass, said


def stand_in_hash(name: str) -> str:
    """The content hash that the parametric stand-in of an object has.

    Args:
        name: A name of the catalogue.
    """
    return content_hash(object_mesh(name, None))
