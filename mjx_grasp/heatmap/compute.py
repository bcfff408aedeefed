"""From meshes to their grasp-affordance heatmaps (method §1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.mesh import (
    Triangles,
    bounds,
    principal_frame_of,
    surface_normals,
    triangles_of,
)
from mjx_grasp.geometry.packing import filled_size
from mjx_grasp.heatmap.backends import backend_for
from mjx_grasp.heatmap.brute import begin_brute, brute_candidates, cut_out
from mjx_grasp.heatmap.candidates import GraspLimits, HeatmapRows, Masses, Surfaces
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap, weigh
from mjx_grasp.heatmap.trees import bvh_candidates, start_trees
from mjx_grasp.objects.refine import refined

if TYPE_CHECKING:
    from mjx_grasp.objects.model import ObjectModel
    from mjx_grasp.robot.description import HandSpec

# Vertices worked on at once: bounds the memory of many meshes.
_MOST_VERTICES = 250_000

_Com = Float[np.ndarray, " 3"] | None

_f32 = partial(np.asarray, dtype=np.float32)


def compute_heatmap(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    com: Float[np.ndarray, " 3"] | None,
    span: tuple[float, float],
    scoring_friction: float,
    config: HeatmapConfig | None = None,
) -> Heatmap:
    """The grasp-affordance heatmap of a mesh (method §1).

    Args:
        vertices: Mesh vertices in [m].
        faces: Their indices, wound so that normals point outwards.
        com: Centre of mass in the mesh's frame, [m]; None takes that of uniform density.
        span: Narrowest and widest grasp of the hand, [m].
        scoring_friction: μ of the hand description, separate from the scene's.
        config: Settings; the defaults if None.

    Returns:
        One candidate per vertex, in the frame of the mesh.

    Raises:
        InputError: The mesh is not one, or a setting cannot work.
    """
    return compute_heatmaps([(vertices, faces)], [com], span, scoring_friction, config)[0]


def compute_heatmaps(
    meshes: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
    coms: Sequence[_Com] | None,
    span: tuple[float, float],
    scoring_friction: float,
    config: HeatmapConfig | None = None,
) -> list[Heatmap]:
    """The heatmaps of many meshes of any sizes, worked on together; see :func:`compute_heatmap`.

    Args:
        meshes: Vertices [m] and faces of each.
        coms: Centre of mass of each; None takes those of uniform density.
        span: Narrowest and widest grasp of the hand, [m].
        scoring_friction: μ of the hand description.
        config: Settings; the defaults if None.

    Raises:
        InputError: One of the meshes is not one, or a setting cannot work.
    """
    config = config or HeatmapConfig()
    if not 0 < span[0] < span[1]:
        raise InputError("span", span, "two lengths in ascending order [m]")
    if not scoring_friction > 0:
        raise InputError("scoring_friction", scoring_friction, "a positive number")
    coms = [None] * len(meshes) if coms is None else coms
    if len(coms) != len(meshes):
        raise InputError("coms", f"{len(coms)}", f"one of each of the {len(meshes)} meshes")
    for com in coms:
        if com is not None and not (np.shape(com) == (3,) and np.isfinite(com).all()):
            raise InputError("com", np.asarray(com).tolist(), "three finite numbers [m], or None")
    centred = [_Centred.of(vertices, faces) for vertices, faces in meshes]
    hand = GraspLimits(_f32(span), _f32(scoring_friction))

    # All are started before the first is waited for.
    heatmaps: dict[int, Heatmap] = {}
    sigma = _f32(config.com_sigma)
    for group in _groups([m.size for m in centred], config):
        work = _started([centred[i] for i in group], [coms[i] for i in group], hand, config)
        for i, found, com in zip(group, *work, strict=True):
            thumb, axis = found["thumb"], found["axis"]
            score = weigh(found["score_without_com"], thumb, axis, _f32(com), sigma)
            heatmaps[i] = Heatmap(vertices=thumb, score=score, **found)
    return [heatmaps[i] for i in range(len(meshes))]


def heatmap_surface(mesh: trimesh.Trimesh, config: HeatmapConfig | None = None) -> trimesh.Trimesh:
    """The mesh with edges as short as candidates are to be close; its vertices are the candidates.

    Every heatmap of an object or of a file is computed on it, so that how a surface happens to be
    cut into triangles does not decide whether it can be grasped.

    Args:
        mesh: In [m].
        config: Settings with the longest edge; the defaults if None.
    """
    return refined(mesh, (config or HeatmapConfig()).edge)


def heatmap_of(obj: ObjectModel, hand: HandSpec, config: HeatmapConfig | None = None) -> Heatmap:
    """The heatmap of an object for a hand, in the object frame; see :func:`heatmaps_of`."""
    return heatmaps_of([obj], hand, config)[0]


def heatmaps_of(
    objects: Sequence[ObjectModel], hand: HandSpec, config: HeatmapConfig | None = None
) -> list[Heatmap]:
    """The heatmaps of objects for a hand, worked on together; see :func:`compute_heatmaps`.

    Candidates are the vertices of each object's :func:`heatmap_surface`.
    """
    surfaces = [heatmap_surface(o.mesh, config) for o in objects]
    return compute_heatmaps(
        [(np.asarray(s.vertices), np.asarray(s.faces)) for s in surfaces],
        [o.com for o in objects],
        hand.span,
        hand.scoring_friction,
        config,
    )


@dataclass(frozen=True)
class _Centred:
    """A mesh around the centre of its bounding box: float32 keeps its digits wherever it lies."""

    vertices: np.ndarray
    """``[v, 3]`` around the centre, [m]."""
    points: np.ndarray
    """The same as float32."""
    faces: np.ndarray
    origin: np.ndarray
    """Centre of the box in the mesh's frame, [m]."""
    diagonal: np.floating
    """Of the box, [m]."""

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray) -> _Centred:
        vertices, faces = _checked(vertices, faces)
        low, high = bounds(vertices)
        origin = 0.5 * (low + high)
        centred = vertices - origin
        return cls(centred, _f32(centred), faces, origin, np.linalg.norm(high - low))

    @cached_property
    def triangles(self) -> Triangles:
        """Its faces, around the centre."""
        return triangles_of(self.vertices, self.faces)

    @property
    def size(self) -> tuple[int, int]:
        """Vertices and faces."""
        return len(self.vertices), len(self.faces)


def _started(
    members: Sequence[_Centred], coms: Sequence[_Com], hand: GraspLimits, config: HeatmapConfig
) -> tuple[list[HeatmapRows], list[np.ndarray]]:
    """Candidates that a GPU may still be at, and centres of mass in the meshes' frames [m]."""
    sizes = [m.size for m in members]
    if backend_for(max(faces for _, faces in sizes), config) == "bvh":
        # First of all: they are built while the rest is made ready.
        trees = start_trees([m.points for m in members], [m.faces for m in members])
        row = _in_a_row([_surfaces(m) for m in members])
        masses, centres = _masses(members, coms)
        return bvh_candidates(trees, row, masses, sizes, hand, config), centres
    begun = begin_brute(_stacked([_surfaces(m) for m in members]), config)
    masses, centres = _masses(members, coms)
    stacked = brute_candidates(begun, Masses(*(x[:, None] for x in masses)), hand, config)
    return [cut_out(stacked, k, vertices) for k, (vertices, _) in enumerate(sizes)], centres


def _surfaces(m: _Centred) -> Surfaces:
    normals = surface_normals(m.triangles, m.faces, len(m.vertices))
    a, b, c, _ = m.triangles
    return Surfaces(
        vertices=m.points,
        normals=_f32(normals.vertices),
        faces=m.faces,
        face_normals=_f32(normals.faces),
        areas=_f32(normals.areas),
        centroids=_f32((a + b + c).T / 3.0),
        diagonal=_f32(m.diagonal)[None],
        origin=_f32(m.origin)[None],
    )


def _masses(members: Sequence[_Centred], coms: Sequence[_Com]) -> tuple[Masses, list[np.ndarray]]:
    """:class:`Masses` of meshes, and their centres of mass in their frames [m]."""
    found = [principal_frame_of(m.triangles, m.faces, m.diagonal) for m in members]
    centres = [
        p.centre + m.origin if com is None else np.asarray(com, np.float64)
        for p, m, com in zip(found, members, coms, strict=True)
    ]
    around = [c - m.origin for c, m in zip(centres, members, strict=True)]
    return Masses(com=_f32(around), axes=_f32([p.axes for p in found])), centres


def _checked(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError("vertices", f"shape {vertices.shape}", "numbers [v, 3] in m")
    if not np.isfinite(vertices).all():
        raise InputError("vertices", "NaN or infinity among them", "finite numbers in m")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("faces", f"{faces.dtype} {faces.shape}", "integers [f, 3]")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("faces", "no faces, or a vertex that is not there", "indices of vertices")
    return vertices, faces.astype(np.int32)


def _groups(sizes: Sequence[tuple[int, int]], config: HeatmapConfig) -> list[list[int]]:
    """Which meshes are worked on together: those of one backend, if brute also of one size."""
    keyed: dict[object, list[list[int]]] = {}
    for i, (vertices, faces) in enumerate(sizes):
        backend = backend_for(faces, config)
        key = backend if backend == "bvh" else (filled_size(vertices), filled_size(faces))
        groups = keyed.setdefault(key, [[]])
        together = sum(sizes[j][0] for j in groups[-1]) + vertices
        if groups[-1] and together > _MOST_VERTICES:
            groups.append([])
        groups[-1].append(i)
    return [group for groups in keyed.values() for group in groups]


def _in_a_row(meshes: Sequence[Surfaces]) -> Surfaces:
    """One mesh after the other, filled up at the end."""
    parts, first = [], 0
    for s in meshes:
        parts.append(s._replace(faces=s.faces + np.int32(first)))
        first += len(s.vertices)
    whole = Surfaces(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return Surfaces(*(block[0] for block in _stacked([whole])))


def _stacked(meshes: Sequence[Surfaces]) -> Surfaces:
    """Meshes of one padded size along a leading axis.

    Filled up with vertices without a normal, and with copies of the last face that have no area.
    """
    vertices, faces = filled_size(len(meshes[0].vertices)), filled_size(len(meshes[0].faces))
    rows = Surfaces(vertices, vertices, faces, faces, faces, faces, None, None)
    fills = Surfaces(*(None,) * len(Surfaces._fields))._replace(normals=0.0, areas=0.0)
    columns = zip(*meshes, strict=True)
    return Surfaces(*(_block(*given) for given in zip(columns, rows, fills, strict=True)))


def _block(arrays: Sequence[np.ndarray], rows: int | None, fill: float | None) -> np.ndarray:
    """Arrays along a leading axis, each filled up to so many rows: with its last one if None."""
    if rows is None:
        return np.stack(arrays)
    block = np.empty((len(arrays), rows, *arrays[0].shape[1:]), arrays[0].dtype)
    for part, array in zip(block, arrays, strict=True):
        part[: len(array)] = array
        part[len(array) :] = array[-1] if fill is None else fill
    return block
