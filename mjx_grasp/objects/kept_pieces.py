"""Convex pieces of objects, worked out once and kept on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rich.console import Console

from mjx_grasp.cli import counting_progress
from mjx_grasp.objects.convex import ConvexConfig, Piece, convex_pieces
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.provenance import usable_cores

_CACHE_FORMAT = 3

Derived = tuple[tuple[Piece, ...], float]
"""Convex pieces and their outward error [m]."""


def pieces_of(
    meshes: Mapping[str, trimesh.Trimesh], cache_dir: Path | None, console: Console | None = None
) -> dict[str, Derived]:
    """Convex pieces and their error by name: those of the cache, and the others on all cores.

    In threads: NumPy, SciPy and CoACD, which take the time, run beside each other in them.

    Args:
        meshes: By name; closed, wound outwards [m].
        cache_dir: Where pieces are kept; ``~/.cache/mjx_grasp`` by default.
        console: For progress.
    """
    entries = {name: _cache_entry(content_hash(m), cache_dir) for name, m in meshes.items()}
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


def content_hash(mesh: trimesh.Trimesh) -> str:
    """SHA-256 of a shape: of its vertices to a micrometre, and its faces."""
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
