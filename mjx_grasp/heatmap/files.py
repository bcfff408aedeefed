"""A heatmap as files: one checked ``.npz`` with everything, and a coloured ``.ply`` to look at.

Members of the ``.npz``; lengths in metres, object frame (the frame of the mesh that was read), v
candidates, one per vertex, and f faces:

| member | shape, type | content |
| --- | --- | --- |
| ``header`` | JSON text | of an archive, with the fields of :class:`HeatmapInfo` |
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
| ``term_width``, … | v float32 | factors of S: width, thumb, wrap, coherence, com, separation |
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Int

from mjx_grasp.errors import FileError
from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.heatmap.steering import Heatmap, Steering
from mjx_grasp.records.archive import (
    ArchiveKind,
    Arrays,
    ChecksumError,
    Header,
    checked,
    read_archive,
    write_archive,
)
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import Finite, NonNegative, Positive, Settings, added

TERMS = ("width", "thumb", "wrap", "coherence", "com", "separation")

_ARRAYS = {
    "vertices": "float32 v 3",
    "normals": "float32 v 3",
    "score": "float32 v",
    "score_without_com": "float32 v",
    "thumb": "float32 v 3",
    "opposing": "float32 v 3",
    "long_axis": "float32 v 3",
    "offset": "float32 v",
    "wrap": "float32 v 2 3",
    "wrap_normals": "float32 v 2 3",
    "centre": "float32 v 3",
    "axis": "float32 v 3",
    "width": "float32 v",
    "valid": "bool v",
}
_TERMS = {f"term_{name}": "float32 v" for name in TERMS}
_ROUNDING = 1e-4
"""By how much products of exponentials in float32 may exceed 1."""


@dataclass(frozen=True)
class HeatmapInfo(Settings):
    """How a heatmap was made."""

    name: str
    """Of the mesh."""
    span: tuple[Positive, Positive]
    """Narrowest and widest grasp of the hand [m]."""
    friction: NonNegative
    """Scoring friction μ [-]."""
    com: tuple[Finite, Finite, Finite]
    """Centre of mass, in the frame of the vertices [m]."""
    anchor: tuple[Finite, Finite, Finite] | None = None
    """What the scores are steered to, in that frame [m]; None for the default heatmap."""
    sigma: Positive | None = None
    """Scale of the distance from the anchor [m]; None for that of `steer_to`."""
    steering: Steering | None = added(None, absent=None)
    """What has to be near the anchor; None for the default heatmap, and where it is not known."""
    size: tuple[NonNegative, NonNegative, NonNegative] | None = added(None, absent=None)
    """Edges of the part around the anchor [m]; None for a point."""


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
    arrays = {name: getattr(heatmap, name) for name in _ARRAYS}
    arrays |= {f"term_{name}": heatmap.terms[name] for name in TERMS}
    write_archive(path, _KIND, info, arrays | {"faces": faces})


def load_heatmap(path: str | Path) -> StoredHeatmap:
    """Reads a heatmap file.

    Raises:
        FileError: Missing, damaged, foreign or of a newer version.
    """
    info, arrays = read_archive(path, _KIND)
    terms = {name: arrays[f"term_{name}"] for name in TERMS}
    heatmap = Heatmap(**{name: arrays[name] for name in _ARRAYS}, terms=terms)
    return StoredHeatmap(heatmap, arrays["faces"], info)


def write_ply(path: str | Path, heatmap: Heatmap, faces: Int[np.ndarray, "f 3"]) -> None:
    """Writes the mesh coloured by its scores as a binary PLY, all or nothing.

    Per vertex: position [m], normal, colour (purple 0 to yellow 1, grey without a candidate),
    and the score itself as ``quality``, which mesh viewers can colour by anew.

    Args:
        path: The file.
        heatmap: Candidates, one per vertex.
        faces: Vertex indices.
    """
    score = np.asarray(heatmap.score, np.float32)
    shown = np.where(np.asarray(heatmap.valid), score, np.nan)
    mesh = trimesh.Trimesh(
        np.asarray(heatmap.vertices),
        faces,
        process=False,
        vertex_normals=np.asarray(heatmap.normals),
        vertex_colors=score_colours(shown),
        vertex_attributes={"quality": score},
    )
    with replacing(path) as temporary:
        mesh.export(temporary, "ply", vertex_normal=True)


def _check(path: Path, info: HeatmapInfo, arrays: Arrays) -> None:
    """Scores within [0, 1], and faces of the vertices."""
    for name in ("score", "score_without_com", *_TERMS):
        if np.any((arrays[name] < 0) | (arrays[name] > 1 + _ROUNDING)):
            raise FileError(path, f"{name} outside [0, 1]", "scores in [0, 1]")
    faces, count = arrays["faces"], len(arrays["vertices"])
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise FileError(path, f"faces up to vertex {faces.max()}", f"vertices below {count}")


def _from_version_1(header: Header, arrays: Arrays) -> tuple[Header, Arrays]:
    """All terms in one array, their names in another, which the checksum leaves out."""
    kept = {name: array for name, array in arrays.items() if name != "term_names"}
    fields, _ = checked(header, kept)
    if tuple(arrays["term_names"].tolist()) != TERMS:
        raise ChecksumError
    return fields, kept | dict(zip(_TERMS, kept.pop("terms").T, strict=True))


_KIND = ArchiveKind(
    format="mjx_grasp heatmap",
    version=2,
    header=HeatmapInfo,
    arrays=_ARRAYS | _TERMS | {"faces": "int32 f 3"},
    check=_check,
    older={1: _from_version_1},
)
