"""Meshes made closed and wound outwards, and parted; what cannot be repaired is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from mjx_grasp.errors import FileError
from mjx_grasp.objects.surface import inside

MIN_EXTENT, MAX_EXTENT = 0.005, 1.0  # m, for each of the three extents
_TO_METRES = "trimesh.load_mesh(FILE).apply_scale(0.001).export(NEW_FILE) makes metres of them"
_MAX_HOLE = 0.15  # a hole's largest extent over the mesh's diagonal that is still filled
_MAX_DROPPED = 0.02  # share of the faces that may go because their edges have more than two faces
_FLAT = 1e-6  # least volume of a component over its area and the diagonal of its box
_ROUNDS = 4  # removing bad faces opens holes, filling them can pinch an edge


def repair(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], path: str | Path
) -> trimesh.Trimesh:
    """Makes a closed, outward-wound mesh of raw triangles, or refuses.

    Steps: merge equal vertices; drop degenerate and duplicate faces and those around edges with
    more than two faces; make the winding agree; fill small holes; drop components without volume,
    such as single triangles; turn the others outward. A hull is never put in a mesh's place.

    Args:
        vertices: Positions, m.
        faces: Vertex indices.
        path: The file's name for the error.

    Raises:
        FileError: They are empty, not finite, in the wrong unit (an extent outside 5 mm to 1 m) or
            open beyond repair.
    """
    _check_content(vertices, faces, path)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    mesh.remove_unreferenced_vertices()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    start = len(faces)
    faces = _without_degenerate(faces)
    dropped = start - len(faces)
    for _ in range(_ROUNDS):
        kept = _without_crowded_edges(faces)
        dropped += len(faces) - len(kept)
        vertices, faces = _fill_holes(vertices, _consistent(kept))
        if _is_manifold(faces):
            break
    if dropped > _MAX_DROPPED * start + 8 or not _is_manifold(faces):
        counts = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)[1]
        raise FileError(
            path,
            f"a surface open beyond repair ({int((counts == 1).sum())} open edges, "
            f"{int((counts > 2).sum())} edges with more than two faces, {dropped} faces dropped)",
            "a closed surface, or one with small holes; close it, or unite its bodies, in a mesh "
            "editor",
        )
    faces = _without_flat(vertices, faces)
    mesh = trimesh.Trimesh(vertices, _outward(vertices, faces), process=False)
    volume = mesh.volume if len(faces) else 0.0
    if volume <= 0.0:
        raise FileError(path, f"an enclosed volume of {volume:.3g} m^3", "a positive volume")
    mesh.remove_unreferenced_vertices()
    return mesh


def _check_content(vertices: np.ndarray, faces: np.ndarray, path: str | Path) -> None:
    if len(vertices) == 0 or len(faces) == 0:
        found = f"an empty mesh ({len(vertices)} vertices, {len(faces)} faces)"
        raise FileError(path, found, "a triangle mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FileError(path, "faces that name missing vertices", "a triangle mesh")
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise FileError(path, f"{bad} vertices that are not finite", "finite coordinates")
    used = vertices[np.unique(faces)]
    extents = used.max(axis=0) - used.min(axis=0)
    if extents.min() < MIN_EXTENT or extents.max() > MAX_EXTENT:
        size = " x ".join(f"{e:.4g}" for e in extents)
        found, expected = f"extents {size} m", f"extents within {MIN_EXTENT} to {MAX_EXTENT} m"
        if 10.0 < extents.max() <= 1000.0:
            found += ", which looks like millimetres"
            expected += f"; in Python, {_TO_METRES}"
        raise FileError(path, found, expected)


def _edges(faces: np.ndarray) -> np.ndarray:
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _is_manifold(faces: np.ndarray) -> bool:
    """Whether every edge has two faces."""
    if len(faces) == 0:
        return False
    counts = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)[1]
    return bool((counts == 2).all())


def _without_degenerate(faces: np.ndarray) -> np.ndarray:
    """Faces with three different vertices, each set of vertices once.

    Slivers of no area stay: they close the surface, and taking them out would open it.
    """
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return faces[np.sort(first)]


def _without_crowded_edges(faces: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(
        np.sort(_edges(faces), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return faces[(counts[inverse.reshape(-1, 3)] <= 2).all(axis=1)]


def _neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces that share an edge, and whether they run along it in opposite directions."""
    edges = _edges(faces)
    order = np.lexsort(np.sort(edges, axis=1).T)
    ordered = np.sort(edges, axis=1)[order]
    same = np.nonzero((ordered[1:] == ordered[:-1]).all(axis=1))[0]
    first, second = order[same], order[same + 1]
    agree = edges[first, 0] == edges[second, 1]
    return np.stack([first // 3, second // 3], axis=1), agree


def _components(faces: np.ndarray) -> tuple[int, np.ndarray]:
    pairs, _ = _neighbours(faces)
    shape = (len(faces), len(faces))
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=shape)
    return connected_components(graph, directed=False)


def _consistent(faces: np.ndarray) -> np.ndarray:
    """Turns faces so that neighbours agree, walking outwards from one face per component."""
    pairs, agree = _neighbours(faces)
    if agree.all():
        return faces
    shape = (len(faces), len(faces))
    # Two faces can share two edges: the sums stay nonzero, so that the graph keeps the pair.
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=shape).tocsr()
    sign = coo_matrix((np.where(agree, 1.0, -1.0), pairs.T), shape=shape).tocsr()
    sign = sign + sign.T
    count, label = connected_components(graph, directed=False)
    orientation = np.ones(len(faces))
    for component in range(count):
        root = int(np.argmax(label == component))
        order, parent = breadth_first_order(graph, root, directed=False)
        for face in order[1:]:
            orientation[face] = orientation[parent[face]] * np.sign(sign[face, parent[face]] or 1.0)
    flip = orientation < 0
    # Most faces of a component stay as they are.
    for component in range(count):
        members = label == component
        if flip[members].mean() > 0.5:
            flip[members] = ~flip[members]
    return np.where(flip[:, None], faces[:, ::-1], faces)


def _without_flat(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The closed components that enclose something."""
    count, label = _components(faces)
    solid = np.zeros(count, bool)
    for component in range(count):
        corners = vertices[faces[label == component]]
        corners = corners - corners.mean(axis=(0, 1))
        a, b, c = corners.swapaxes(0, 1)
        volume = abs(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
        solid[component] = volume > _FLAT * area * np.linalg.norm(np.ptp(corners, axis=(0, 1)))
    return faces[solid[label]]


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Turns closed components of negative volume, except the walls of cavities.

    Where the volume of all is negative, all are inside out, and cavities with them.
    """
    count, label = _components(faces)
    parts = (trimesh.Trimesh(vertices, faces[label == c], process=False) for c in range(count))
    volume = np.array([part.volume for part in parts])
    if volume.sum() < 0.0:
        faces, volume = faces[:, ::-1], -volume
    outward = np.where((volume < 0.0)[label][:, None], faces[:, ::-1], faces)
    found = outward.copy()
    for component in np.flatnonzero(volume < 0.0) if count > 1 else ():
        members = label == component
        others = trimesh.Trimesh(vertices, outward[~members], process=False)
        if inside(others, vertices[faces[members][0, 0]][None])[0]:
            found[members] = faces[members]
    return found


def _fill_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closes boundary loops smaller than the limit by a fan around their centroid."""
    edges = _edges(faces)
    order = np.lexsort(np.sort(edges, axis=1).T)
    ordered = np.sort(edges, axis=1)[order]
    paired = np.zeros(len(edges), bool)
    same = (ordered[1:] == ordered[:-1]).all(axis=1)
    paired[order[1:][same]] = True
    paired[order[:-1][same]] = True
    limit = _MAX_HOLE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    new_vertices, new_faces = [vertices], [faces]
    total = len(vertices)
    for loop in _loops(edges[~paired]):
        if np.ptp(vertices[loop], axis=0).max() > limit:
            continue
        # The fan runs against the boundary's direction, so that its winding agrees with it.
        following = np.roll(loop, -1)
        if len(loop) == 3:
            new_faces.append(loop[None, ::-1])
        else:
            new_vertices.append(vertices[loop].mean(axis=0)[None])
            new_faces.append(np.stack([following, loop, np.full_like(loop, total)], axis=1))
            total += 1
    return np.concatenate(new_vertices), np.concatenate(new_faces)


def _loops(half_edges: np.ndarray) -> list[np.ndarray]:
    """Chains directed boundary edges into simple closed loops; at a pinch the inner loop first."""
    outgoing: dict[int, list[int]] = {}
    for start, end in half_edges.tolist():
        outgoing.setdefault(start, []).append(end)
    loops = []
    for start in list(outgoing):
        path, position = [start], {start: 0}
        while outgoing.get(path[-1]):
            following = outgoing[path[-1]].pop()
            if following in position:
                loop = path[position[following] :]
                if len(loop) >= 3:
                    loops.append(np.array(loop, dtype=np.int64))
                for vertex in loop[1:]:
                    del position[vertex]
                path = path[: position[following] + 1]
            else:
                position[following] = len(path)
                path.append(following)
    return loops


def split(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """The connected components of a mesh, in the order of their first face."""
    faces = np.asarray(mesh.faces)
    count, label = _components(faces)
    parts = []
    for component in range(count):
        used, index = np.unique(faces[label == component], return_inverse=True)
        parts.append(trimesh.Trimesh(mesh.vertices[used], index.reshape(-1, 3), process=False))
    return parts
