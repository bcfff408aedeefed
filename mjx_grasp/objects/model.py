"""Object models."""
from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from mjx_grasp.atomic import replacing
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.convex import Piece, convex_pieces
from mjx_grasp.objects.inertia import mass_properties
from mjx_grasp.objects.meshes import centred, find_scan, read_mesh
from mjx_grasp.objects.resting import RestingPose, resting_poses


@dataclass(frozen=True)
class ObjectModel:
    """An object."""

    name: str
    source: str
    mesh: trimesh.Trimesh
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    pieces: tuple[Piece, ...]
    outward_error_95: float
    resting: tuple[RestingPose, ...]
    content_hash: str


def load_object(name: str, objects_dir: Path | None = None, cache_dir: Path | None = None) -> ObjectModel:
    """Loads an object."""
    info = load_catalogue()[name]
    mesh, _ = read_mesh(find_scan(objects_dir, info.scan_names))
    mesh = centred(mesh, info.scale)
    digest = hashlib.sha256(np.round(mesh.vertices * 1e6).astype(np.int64).tobytes() + np.asarray(mesh.faces, np.int64).tobytes()).hexdigest()
    path = Path.home() / ".cache/mjx_grasp_tmp" / f"{digest}.pkl"
    com, inertia = mass_properties(mesh, info.mass)
    if path.exists():
        pieces, error, resting = pickle.loads(path.read_bytes())
    else:
        pieces, error = convex_pieces(mesh)
        resting = resting_poses(pieces, com)
        with replacing(path) as t:
            t.write_bytes(pickle.dumps((pieces, error, resting)))
    return ObjectModel(name, "scan", mesh, info.mass, com, inertia, pieces, error, resting, digest)


def load_objects(names: Sequence[str], objects_dir: Path | None = None) -> list[ObjectModel]:
    """Loads several."""
    return [load_object(n, objects_dir) for n in names]
