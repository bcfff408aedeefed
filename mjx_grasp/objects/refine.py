"""Finer triangles on the same surface: candidates are vertices, and CAD faces have few."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float, Int

_MOST_FACES = 20_000  # about: larger surfaces get longer edges
_ROUNDS = 24


def refined(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    """The mesh with no edge longer than a limit; the surface and its closedness stay.

    Args:
        mesh: In [m].
        edge: Longest edge [m]; longer on a surface so large that there would be far too many
            faces. 0 keeps the mesh as it is.
    """
    if edge <= 0:
        return mesh
    # Even triangles of edge e cover about 0.43 e² each, halved ones about half of that.
    limit = max(edge, float(np.sqrt(mesh.area / (0.25 * _MOST_FACES))))
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    for _ in range(_ROUNDS):
        vertices, faces, split = _halved(vertices, faces, limit)
        if not split:
            break
    return trimesh.Trimesh(vertices, faces, process=False)


def _halved(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], limit: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], int]:
    """Halves every edge above the limit in both faces that share it, and counts them."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    long = lengths > limit
    count = int(long.sum())
    if not count:
        return vertices, faces, 0
    middle = np.full(len(edges), -1, np.int64)
    middle[long] = len(vertices) + np.arange(count)
    halves = middle[inverse.reshape(-1, 3)]  # of the edges 01, 12, 20 of each face
    new_vertices = np.concatenate([vertices, vertices[edges[long]].mean(axis=1)])
    is_split = halves >= 0
    number = is_split.sum(axis=1)
    # Faces are turned so that, of one or two split edges, the first is 01.
    turn = np.argmax(is_split & ~((number == 2)[:, None] & np.roll(is_split, 1, axis=1)), axis=1)
    order = (turn[:, None] + np.arange(3)) % 3
    (a, b, c), (ab, bc, ca) = (np.take_along_axis(x, order, axis=1).T for x in (faces, halves))
    pieces = [
        _rows(number == 0, (a, b, c)),
        _rows(number == 1, (a, ab, c), (ab, b, c)),
        _rows(number == 2, (ab, b, bc), (a, ab, c), (ab, bc, c)),
        _rows(number == 3, (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
    ]
    return new_vertices, np.concatenate(pieces), count


def _rows(which: np.ndarray, *faces: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.stack(corners, axis=1)[which] for corners in faces])
