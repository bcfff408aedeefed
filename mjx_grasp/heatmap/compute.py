"""From meshes to their grasp-affordance heatmaps (method §1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.mesh import bounds, corner_rows, mass_properties, surface_normals
from mjx_grasp.heatmap.backends import (
    backend_for,
    begin_brute,
    brute_candidates,
    bvh_candidates,
    cut_out,
    start_trees,
)
from mjx_grasp.heatmap.candidates import Candidates, Masses, Surfaces
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap, weigh

if TYPE_CHECKING:
    from mjx_grasp.objects.model import ObjectModel
    from mjx_grasp.robot.spec import HandSpec

# Arrays are padded to multiples of at least this, and of an eighth of their size: meshes of
# similar size share one compilation.
_LEAST_STEP = 512
# Vertices worked on at once: bounds the memory of many meshes.
_MOST_VERTICES = 250_000

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
    meshes: Sequence[tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]],
    coms: Sequence[Float[np.ndarray, " 3"] | None] | None,
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
    centred = [_Centred.of(vertices, faces) for vertices, faces in meshes]
    hand = _f32(span), _f32(scoring_friction)

    # All are started before the first is waited for.
    started = [
        (group, _started([centred[i] for i in group], [coms[i] for i in group], *hand, config))
        for group in _groups([m.size for m in centred], config)
    ]
    heatmaps: dict[int, Heatmap] = {}
    sigma = _f32(config.com_sigma)
    for group, work in started:
        for i, found, (vertices, normals), centre in zip(group, *work, strict=True):
            score = weigh(found.score_without_com, vertices, found.axis, centre, sigma)
            parts = found._asdict() | {"score": score, "thumb": vertices}
            heatmaps[i] = Heatmap(vertices=vertices, normals=normals, **parts)
    return [heatmaps[i] for i in range(len(meshes))]


def heatmap_of(obj: ObjectModel, hand: HandSpec, config: HeatmapConfig | None = None) -> Heatmap:
    """The heatmap of an object for a hand, in the object frame; see :func:`compute_heatmap`."""
    return heatmaps_of([obj], hand, config)[0]


def heatmaps_of(
    objects: Sequence[ObjectModel], hand: HandSpec, config: HeatmapConfig | None = None
) -> list[Heatmap]:
    """The heatmaps of objects for a hand, worked on together; see :func:`compute_heatmaps`."""
    return compute_heatmaps(
        [(np.asarray(o.mesh.vertices), np.asarray(o.mesh.faces)) for o in objects],
        [o.com for o in objects],
        hand.span,
        hand.scoring_friction,
        config,
    )


@dataclass(frozen=True)
class _Centred:
    """A mesh around the centre of its bounding box: float32 keeps its digits wherever it lies."""

    given: np.ndarray
    """``[v, 3]`` vertices in the mesh's frame, [m]."""
    vertices: np.ndarray
    """The same around the centre."""
    points: np.ndarray
    """These as float32."""
    faces: np.ndarray
    origin: np.ndarray
    """Centre of the box in the mesh's frame, [m]."""
    diagonal: np.floating
    """Of the box, [m]."""

    @classmethod
    def of(cls, vertices, faces) -> _Centred:
        vertices, faces = _checked(vertices, faces)
        low, high = bounds(vertices)
        origin = 0.5 * (low + high)
        centred = vertices - origin
        return cls(vertices, centred, _f32(centred), faces, origin, np.linalg.norm(high - low))

    @property
    def size(self) -> tuple[int, int]:
        """Vertices and faces."""
        return len(self.vertices), len(self.faces)


class _Work(NamedTuple):
    """Work on a group of meshes that a GPU may still be at; an item for each mesh.

    Attributes:
        candidates: In the frame of the mesh.
        thumbs: Vertices and normals there.
        centres: Centres of mass there, [m].
    """

    candidates: list[Candidates]
    thumbs: list[Any]
    centres: list[np.ndarray]


def _started(members, coms, span, friction, config) -> _Work:
    sizes = [m.size for m in members]
    if backend_for(max(faces for _, faces in sizes), config) == "bvh":
        # First of all: they are built while the rest is made ready.
        trees = start_trees([m.points for m in members], [m.faces for m in members])
        surfaces = [_surfaces(m) for m in members]
        masses, centres = _masses(members, coms)
        row = _in_a_row(surfaces)
        found = bvh_candidates(trees, row, masses, sizes, span, friction, config)
    else:
        surfaces = [_surfaces(m) for m in members]
        begun = begin_brute(_stacked(surfaces), config)
        masses, centres = _masses(members, coms)
        each = Masses(*(x[:, None] for x in masses))
        stacked = brute_candidates(begun, each, span, friction, config)
        found = [cut_out(stacked, k, vertices) for k, (vertices, _) in enumerate(sizes)]
    thumbs = [(s.vertices + s.origin, _some_normals(s.normals)) for s in surfaces]
    return _Work(found, jax.device_put(thumbs), [_f32(c) for c in centres])


def _some_normals(normals: np.ndarray) -> np.ndarray:
    """Upwards where there is none."""
    some = np.any(normals != 0.0, axis=1, keepdims=True)
    return np.where(some, normals, _f32([0.0, 0.0, 1.0]))


def _surfaces(m: _Centred) -> Surfaces:
    normals = surface_normals(m.vertices, m.faces)
    return Surfaces(
        vertices=m.points,
        normals=_f32(normals.vertices),
        faces=m.faces,
        face_normals=_f32(normals.faces),
        areas=_f32(normals.areas),
        centroids=_f32(np.sum(corner_rows(m.vertices, m.faces), axis=0).T / 3.0),
        diagonal=_f32(m.diagonal)[None],
        origin=_f32(m.origin)[None],
    )


def _masses(members, coms) -> tuple[Masses, list[np.ndarray]]:
    """:class:`Masses` of meshes, and their centres of mass in their frames [m]."""
    found = [mass_properties(m.given, m.faces) for m in members]
    centres = [
        p.centre if com is None else np.asarray(com, np.float64)
        for p, com in zip(found, coms, strict=True)
    ]
    around = [c - m.origin for c, m in zip(centres, members, strict=True)]
    return Masses(com=_f32(around), axes=_f32([p.axes for p in found])), centres


def _checked(vertices, faces):
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise InputError("vertices", f"shape {vertices.shape}", "finite numbers [v, 3] in m")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("faces", f"{faces.dtype} {faces.shape}", "integers [f, 3]")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("faces", "no faces, or a vertex that is not there", "indices of vertices")
    return vertices, faces.astype(np.int32)


def _bucket(n: int) -> int:
    step = max(_LEAST_STEP, 2 ** max(0, n.bit_length() - 4))
    return -(-n // step) * step


def _groups(sizes: Sequence[tuple[int, int]], config: HeatmapConfig) -> list[list[int]]:
    """Which meshes are worked on together: those of one backend, if brute also of one size."""
    keyed: dict[object, list[list[int]]] = {}
    for i, (vertices, faces) in enumerate(sizes):
        backend = backend_for(faces, config)
        key = backend if backend == "bvh" else (_bucket(vertices), _bucket(faces))
        groups = keyed.setdefault(key, [[]])
        together = sum(sizes[j][0] for j in groups[-1]) + vertices
        if groups[-1] and together > _MOST_VERTICES:
            groups.append([])
        groups[-1].append(i)
    return [group for groups in keyed.values() for group in groups]


def _padded(s: Surfaces) -> Surfaces:
    """Filled up: vertices without a normal, and copies of the last face that have no area."""
    vertices = _bucket(len(s.vertices)) - len(s.vertices)
    faces = _bucket(len(s.faces)) - len(s.faces)

    def more(array, count, fill):
        return np.concatenate([array, np.broadcast_to(fill, (count, *array.shape[1:]))])

    return s._replace(
        vertices=more(s.vertices, vertices, s.vertices[-1]),
        normals=more(s.normals, vertices, np.float32(0.0)),
        faces=more(s.faces, faces, s.faces[-1]),
        face_normals=more(s.face_normals, faces, s.face_normals[-1]),
        areas=more(s.areas, faces, np.float32(0.0)),
        centroids=more(s.centroids, faces, s.centroids[-1]),
    )


def _in_a_row(meshes: Sequence[Surfaces]) -> Surfaces:
    parts, first = [], 0
    for s in meshes:
        parts.append(s._replace(faces=s.faces + np.int32(first)))
        first += len(s.vertices)
    return _padded(Surfaces(*(np.concatenate(columns) for columns in zip(*parts, strict=True))))


def _stacked(meshes: Sequence[Surfaces]) -> Surfaces:
    parts = [_padded(s) for s in meshes]
    return Surfaces(*(np.stack(columns) for columns in zip(*parts, strict=True)))
