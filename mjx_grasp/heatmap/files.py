"""A heatmap as files: one checked ``.npz`` with everything, and a coloured ``.ply`` to look at.

Members of the ``.npz``; lengths in metres, object frame (the frame of the mesh that was read), v
candidates, one per vertex, and f faces:

| member | shape, type | content |
| --- | --- | --- |
| ``header`` | JSON text | format, version, checksum, and the fields of :class:`HeatmapInfo` |
| ``vertices`` | v×3 float32 | of the mesh as it was read and repaired |
| ``faces`` | f×3 int32 | vertex indices, wound outwards |
| ``normals`` | v×3 float32 | outward unit normals |
| ``score`` | v float32 | S in [0, 1]; with an anchor in the header, the steered score |
| ``score_without_com`` | v float32 | S without its centre-of-mass term: what steering starts from |
| ``thumb`` | v×3 float32 | thumb contact, the vertex itself |
| ``wrap`` | v×2×3 float32 | index and middle contacts |
| ``wrap_normals`` | v×2×3 float32 | outward unit normals there |
| ``opposing``, ``long_axis`` | v×3 float32 | where the ray leaves the mesh; the long axis there |
| ``offset`` | v float32 | half distance of the wrap seeds |
| ``centre``, ``axis`` | v×3 float32 | of the wrap contacts; unit grasp axis from the thumb to it |
| ``width`` | v float32 | distance from the thumb to the centre |
| ``valid`` | v bool | whether there is a candidate; where not, scores are 0 and the rest is void |
| ``terms`` | v×6 float32 | factors of S, columns in the order of ``term_names`` |
| ``term_names`` | 6 strings | width, thumb, wrap, coherence, com, separation |
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import FileError
from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.heatmap.steering import Heatmap
from mjx_grasp.records.atomic import replacing

FORMAT = "mjx_grasp heatmap"
VERSION = 1
TERMS = ("width", "thumb", "wrap", "coherence", "com", "separation")

# Of every array with one row per vertex: the shape behind the rows, and the type.
_SCHEMA: dict[str, tuple[tuple[int, ...], type]] = {
    "vertices": ((3,), np.float32),
    "normals": ((3,), np.float32),
    "score": ((), np.float32),
    "score_without_com": ((), np.float32),
    "thumb": ((3,), np.float32),
    "opposing": ((3,), np.float32),
    "long_axis": ((3,), np.float32),
    "offset": ((), np.float32),
    "wrap": ((2, 3), np.float32),
    "wrap_normals": ((2, 3), np.float32),
    "centre": ((3,), np.float32),
    "axis": ((3,), np.float32),
    "width": ((), np.float32),
    "valid": ((), np.bool_),
    "terms": ((len(TERMS),), np.float32),
}
_SCORES = ("score", "score_without_com", "terms")
_ROUNDING = 1e-4  # float32 products of exponentials may exceed 1 by this


@dataclass(frozen=True)
class HeatmapInfo:
    """How a heatmap was made."""

    name: str
    """Of the mesh."""
    span: tuple[float, float]
    """Narrowest and widest grasp of the hand [m]."""
    friction: float
    """Scoring friction μ [-]."""
    com: tuple[float, float, float]
    """Centre of mass, object frame [m]."""
    anchor: tuple[float, float, float] | None = None
    """What the scores are steered to, object frame [m]; None for the default heatmap."""
    sigma: float | None = None
    """Scale of the distance from the anchor to the grasp axis [m]."""


@dataclass(frozen=True, eq=False)
class StoredHeatmap:
    """A heatmap with its mesh and how it was made; arrays are NumPy's."""

    heatmap: Heatmap
    faces: Int[np.ndarray, "f 3"]
    info: HeatmapInfo


def save_heatmap(
    path: str | Path, heatmap: Heatmap, faces: Int[np.ndarray, "f 3"], info: HeatmapInfo
) -> None:
    """Writes the compressed ``.npz`` that this module describes, all or nothing.

    Raises:
        FileError: The arrays do not fit each other, or hold numbers that are not finite.
    """
    arrays: dict[str, np.ndarray] = {
        name: np.ascontiguousarray(getattr(heatmap, name), dtype)
        for name, (_, dtype) in _SCHEMA.items()
        if name != "terms"
    }
    columns = [np.asarray(heatmap.terms[name], np.float32) for name in TERMS]
    arrays["terms"] = np.stack(columns, axis=1)
    arrays["faces"] = np.ascontiguousarray(faces, np.int32)
    _check(path, arrays)
    header: dict[str, Any] = {"format": FORMAT, "version": VERSION, **asdict(info)}
    header["checksum"] = _checksum(arrays, header)
    members: dict[str, Any] = {
        "header": np.array(json.dumps(header)),
        "term_names": np.array(TERMS),
        **arrays,
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **members)


def load_heatmap(path: str | Path) -> StoredHeatmap:
    """Reads a heatmap file.

    Raises:
        FileError: Missing, damaged, foreign or of a newer version.
    """
    path, expected = Path(path), f"a {FORMAT} file (.npz)"
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise FileError(path, "another kind of file", expected)
            if header.get("version") != VERSION:
                found = f"version {header.get('version')}"
                raise FileError(path, found, f"version {VERSION}; newer ones need a newer package")
            names = tuple(str(name) for name in file["term_names"])
            arrays = {name: file[name] for name in (*_SCHEMA, "faces")}
    except FileError:
        raise
    except FileNotFoundError:
        raise FileError(path, "no such file", expected) from None
    except (KeyError, json.JSONDecodeError):
        raise FileError(path, "another kind of file", expected) from None
    except Exception as error:
        # Depending on where it is damaged, reading a zip file raises nearly anything.
        raise FileError(path, "a damaged or foreign file", expected) from error
    if names != TERMS or _checksum(arrays, header) != header.get("checksum"):
        raise FileError(path, "content that does not match its checksum", "an undamaged file")
    _check(path, arrays)
    faces, terms = arrays.pop("faces"), arrays.pop("terms")
    fields: dict[str, Any] = arrays
    columns = {name: terms[:, k] for k, name in enumerate(TERMS)}
    return StoredHeatmap(Heatmap(**fields, terms=columns), faces, _info(header))


def write_ply(
    path: str | Path,
    heatmap: Heatmap,
    faces: Int[np.ndarray, "f 3"],
    score: Float[np.ndarray, " v"] | None = None,
    top: float = 1.0,
) -> None:
    """Writes the mesh coloured by its scores as a binary PLY, all or nothing.

    Per vertex: position [m], normal, colour (purple 0 to yellow ``top``, grey without a candidate),
    and the score itself as ``quality``, which mesh viewers can colour by anew.

    Args:
        path: The file.
        heatmap: Candidates, one per vertex.
        faces: Vertex indices.
        score: Other scores than the heatmap's own, for example steered ones.
        top: The score that gets the yellow end of the scale.
    """
    score = np.asarray(heatmap.score if score is None else score, np.float32)
    shown = np.where(np.asarray(heatmap.valid), score, np.nan)
    lengths = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    colours = [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(score), np.dtype([*lengths, *colours, ("quality", "<f4")]))
    columns = np.concatenate([np.asarray(heatmap.vertices), np.asarray(heatmap.normals)], axis=1)
    for (name, _), column in zip(lengths, columns.T, strict=True):
        rows[name] = column
    for (name, _), column in zip(colours, score_colours(shown, top).T, strict=True):
        rows[name] = column
    rows["quality"] = score
    corners = np.empty(len(faces), np.dtype([("count", "u1"), ("index", "<i4", 3)]))
    corners["count"], corners["index"] = 3, faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {FORMAT}, metres",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name, _ in lengths),
        *(f"property uchar {name}" for name, _ in colours),
        "property float quality",
        f"element face {len(corners)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(rows.tobytes() + corners.tobytes())


def _info(header: Mapping[str, Any]) -> HeatmapInfo:
    fields: dict[str, Any] = {}
    for name in HeatmapInfo.__dataclass_fields__:
        value = header.get(name)
        fields[name] = tuple(value) if isinstance(value, list) else value
    return HeatmapInfo(**fields)


def _checksum(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> str:
    """SHA-256 over all that the file says."""
    digest = hashlib.sha256()
    said = {key: value for key, value in header.items() if key != "checksum"}
    # Written and read back alike: tuples become lists.
    digest.update(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Shapes, types, finite numbers, scores within [0, 1], and faces of the vertices."""
    count = len(arrays["vertices"])
    for name, (tail, dtype) in _SCHEMA.items():
        array = arrays[name]
        if array.shape != (count, *tail) or array.dtype != dtype:
            expected = f"{dtype.__name__} {(count, *tail)}"
            raise FileError(path, f"{name} {array.dtype} {array.shape}", expected)
        if not np.isfinite(array).all():
            raise FileError(path, f"{name} with numbers that are not finite", "finite numbers")
    for name in _SCORES:
        if np.any((arrays[name] < 0) | (arrays[name] > 1 + _ROUNDING)):
            raise FileError(path, f"{name} outside [0, 1]", "scores in [0, 1]")
    faces = arrays["faces"]
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != np.int32:
        raise FileError(path, f"faces {faces.dtype} {faces.shape}", "int32 (any, 3)")
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise FileError(path, f"faces up to vertex {faces.max()}", f"vertices below {count}")
