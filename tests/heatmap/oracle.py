"""The whole score of method.md §1 once more: double precision, NumPy, SciPy, trimesh and embree.

Written from the method's text alone; nothing of the package is called. It is the oracle of the
tests, and the pipeline that benchmarks/heatmap.py compares with: vectorised, embree for the rays,
trimesh's closest points, a k-d tree for the neighbourhoods.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

OFFSETS = np.array([0.005, 0.010, 0.015, 0.020, 0.025])
RADIUS, FEWEST = 0.015, 12
ISOTROPY, FLATNESS = 0.05, 1e-4
PARALLEL = np.radians(10.0)
NARROW_SIGMA, WIDTH_SIGMA, COM_SIGMA, SEPARATION = 0.025, 0.010, 0.030, 0.030
COHERENCE = np.radians(30.0)
# Principal moments that agree to this have no axes of their own.
EQUAL_MOMENTS = 1e-6
# A face square to a normal, up to rounding, does not face the same way.
SQUARE = 1e-6


@dataclass
class Surface:
    """A mesh with the normals and mass properties of method §1."""

    mesh: trimesh.Trimesh
    face_normals: np.ndarray
    areas: np.ndarray
    normals: np.ndarray
    com: np.ndarray
    axes: np.ndarray
    """``[3, 3]`` principal axes as rows, the longest extent first."""
    moments: np.ndarray
    """``[3]`` second moments along them."""

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))


@dataclass
class Result:
    """The heatmap, with every intermediate result for the comparison."""

    surface: Surface
    score: np.ndarray
    valid: np.ndarray
    opposing: np.ndarray
    opposing_normal: np.ndarray
    hit_face: np.ndarray
    long_axis: np.ndarray
    eigenvalues: np.ndarray
    """``[v, 2]`` of C over the area, the larger first."""
    wraps: np.ndarray
    """``[h, 2, v, 3]`` projected seeds of every offset."""
    scores: np.ndarray
    """``[h, v]`` of every offset."""
    choice: np.ndarray
    seconds: dict[str, float] = field(default_factory=dict)


def normalised(x: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    return np.divide(x, length, out=np.zeros_like(x), where=length > 0)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))


def surface_of(mesh: trimesh.Trimesh, com: np.ndarray | None = None) -> Surface:
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weighted = np.zeros((len(mesh.vertices), 3))
    for k in range(3):
        np.add.at(weighted, mesh.faces[:, k], cross)
    if mesh.is_watertight:
        centre = mesh.center_mass
        inertia = mesh.moment_inertia
    else:  # of the surface: each triangle by its three edge midpoints, exact to second order
        middles = np.concatenate([0.5 * (corners + np.roll(corners, 1, axis=1))], axis=0)
        mass = np.repeat(0.5 * np.linalg.norm(cross, axis=1)[:, None] / 3.0, 3, axis=1).ravel()
        points = middles.reshape(-1, 3)
        centre = (mass[:, None] * points).sum(axis=0) / mass.sum()
        r = points - centre
        inertia = np.einsum("n,n,ij->ij", mass, (r * r).sum(axis=1), np.eye(3))
        inertia -= np.einsum("n,ni,nj->ij", mass, r, r)
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    moments, vectors = np.linalg.eigh(second)
    moments, axes = moments[::-1], vectors.T[::-1]
    return Surface(
        mesh=mesh,
        face_normals=normalised(cross),
        areas=0.5 * np.linalg.norm(cross, axis=1),
        normals=normalised(weighted),
        com=centre if com is None else np.asarray(com, float),
        axes=settled(axes, moments),
        moments=moments,
    )


def settled(axes: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Axes of equal moments span a space; in it, those nearest x, y, z in this order are taken."""
    settled, start = [], 0
    while start < 3:
        stop = start + 1
        while stop < 3 and moments[stop - 1] - moments[stop] <= EQUAL_MOMENTS * moments[0]:
            stop += 1
        space = axes[start:stop]
        if len(space) == 1:
            settled.append(space[0])
        else:
            projector = space.T @ space
            for _ in range(len(space)):
                lengths = np.linalg.norm(projector, axis=0)
                best = int(np.flatnonzero(lengths >= lengths.max() - 1e-6)[0])
                axis = projector[:, best] / lengths[best]
                settled.append(axis)
                projector = projector - np.outer(axis, axis) @ projector
        start = stop
    return np.array(settled)


def normals_on(surface: Surface, points: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Barycentric interpolation of the vertex normals, renormalised."""
    a, b, c = np.moveaxis(surface.mesh.vertices[surface.mesh.faces[face]], 1, 0)
    area = np.cross(b - a, c - a)
    whole = np.maximum((area * area).sum(axis=1), 1e-300)
    weights = np.stack(
        [
            (np.cross(c - b, points - b) * area).sum(axis=1) / whole,
            (np.cross(a - c, points - c) * area).sum(axis=1) / whole,
            (np.cross(b - a, points - a) * area).sum(axis=1) / whole,
        ],
        axis=1,
    )
    weights = np.clip(weights, 0.0, None)
    corners = surface.normals[surface.mesh.faces[face]]
    return normalised((weights[:, :, None] * corners).sum(axis=1))


def farthest_hits(surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step 1 by the first hit of the ray cast back from beyond the mesh: (hit, distance, face)."""
    mesh, directions = surface.mesh, -surface.normals
    beyond = mesh.vertices + 2.0 * surface.diagonal * directions
    faces, rays = RayMeshIntersector(mesh).intersects_id(beyond, -directions, multiple_hits=False)
    face = np.zeros(len(mesh.vertices), int)
    face[rays] = faces
    across = surface.face_normals[face]
    corner = mesh.vertices[mesh.faces[face, 0]]
    slope = (across * directions).sum(axis=1)
    away = (across * (corner - mesh.vertices)).sum(axis=1)
    distance = np.divide(away, slope, out=np.zeros_like(away), where=np.abs(slope) > 1e-12)
    hit = np.zeros(len(face), bool)
    hit[rays] = True
    hit &= distance > 1e-4 * surface.diagonal
    return hit, np.where(hit, distance, 0.0), face


def long_axes(surface: Surface, points: np.ndarray, normals: np.ndarray):
    """Step 2: (axes, eigenvalues of C over the area)."""
    kept = np.flatnonzero(surface.areas > 0)
    centroids = surface.mesh.vertices[surface.mesh.faces[kept]].mean(axis=1)
    tree = cKDTree(centroids)
    near = tree.query_ball_point(points, RADIUS, return_sorted=False)
    counts = np.array([len(n) for n in near])
    row = np.repeat(np.arange(len(points)), counts)
    face = kept[np.concatenate([np.asarray(n, int) for n in near])]
    alike = (surface.face_normals[face] * normals[row]).sum(axis=1) > SQUARE
    row, face = row[alike], face[alike]
    few = np.flatnonzero(np.bincount(row, minlength=len(points)) < FEWEST)
    if len(few):
        more = [nearest_alike(surface, kept, centroids, points[i], normals[i]) for i in few]
        ours = ~np.isin(row, few)
        row = np.concatenate([row[ours], np.repeat(few, [len(m) for m in more])])
        face = np.concatenate([face[ours], *more])

    def total(values):
        return np.bincount(row, values, len(points))

    first, second = across(normals)
    n, weight = surface.face_normals[face], surface.areas[face]
    area = np.maximum(total(weight), 1e-300)
    # Along the two tangents, about their own means.
    x, y = (n * first[row]).sum(axis=1), (n * second[row]).sum(axis=1)
    x -= (total(weight * x) / area)[row]
    y -= (total(weight * y) / area)[row]
    xx, xy, yy = (total(weight * p) / area for p in (x * x, x * y, y * y))
    values, vectors = np.linalg.eigh(np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2))
    least = vectors[:, :1, 0] * first + vectors[:, 1:, 0] * second
    small, large = values[:, 0], values[:, 1]
    vague = (large - small <= ISOTROPY * large) | (large < FLATNESS)
    axes = np.where(vague[:, None], reference(surface, normals), normalised(least))
    return axes, np.stack([large, small], axis=1)


def nearest_alike(surface, kept, centroids, point, normal) -> np.ndarray:
    alike = surface.face_normals[kept] @ normal > SQUARE
    distance = np.where(alike, np.linalg.norm(centroids - point, axis=1), np.inf)
    order = np.argsort(distance, kind="stable")[:FEWEST]
    return kept[order[np.isfinite(distance[order])]]


def across(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = normalised(np.cross(normals, least))
    return first, np.cross(normals, first)


def reference(surface: Surface, normals: np.ndarray) -> np.ndarray:
    long, middle = surface.axes[0], surface.axes[1]
    lean = np.arccos(np.clip(np.abs(normals @ long), 0, 1))
    axis = np.where((lean < PARALLEL)[:, None], middle, long)
    return normalised(axis - (axis * normals).sum(axis=1)[:, None] * normals)


def closest(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of the mesh and their faces.

    In millimetres: trimesh takes faces as equally near whose squared distances differ by less than
    1e-8, which in metres is a tenth of a millimetre.
    """
    large = trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces, process=False)
    nearest, _, face = trimesh.proximity.closest_point(large, 1e3 * points)
    return 1e-3 * nearest, face


def heatmap(
    mesh: trimesh.Trimesh,
    span: tuple[float, float] = (0.02, 0.09),
    friction: float = 0.5,
    com: np.ndarray | None = None,
) -> Result:
    """The score of every vertex (method §1, steps 1 to 5)."""
    clock, seconds = time.perf_counter, {}
    start = clock()
    surface = surface_of(mesh, com)
    vertices, inward = mesh.vertices, -surface.normals
    seconds["surface"], start = clock() - start, clock()
    hit, distance, hit_face = farthest_hits(surface)
    opposing = vertices + distance[:, None] * inward
    opposing_normal = normals_on(surface, opposing, hit_face)
    seconds["rays"], start = clock() - start, clock()
    axes, eigenvalues = long_axes(surface, opposing, opposing_normal)
    seconds["long_axes"], start = clock() - start, clock()
    signs = np.array([1.0, -1.0])
    seeds = opposing + (OFFSETS[:, None] * signs)[:, :, None, None] * axes
    wraps, wrap_face = closest(mesh, seeds.reshape(-1, 3))
    seconds["closest"], start = clock() - start, clock()
    wrap_normals = normals_on(surface, wraps, wrap_face).reshape(seeds.shape)
    wraps = wraps.reshape(seeds.shape)

    centre = wraps.mean(axis=1)
    width = np.linalg.norm(centre - vertices, axis=-1)
    axis = normalised(centre - vertices)
    cone = 0.5 * np.arctan(friction)
    below, above = np.maximum(0, span[0] - width), np.maximum(0, width - span[1])
    s_w = np.exp(-((below / NARROW_SIGMA) ** 2 + (above / WIDTH_SIGMA) ** 2))
    s_t = np.exp(-((angle(axis, inward) / cone) ** 2))
    s_k = np.exp(-((angle(-axis[:, None], -wrap_normals) / cone) ** 2))
    s_coh = np.exp(-((angle(wrap_normals[:, 0], wrap_normals[:, 1]) / COHERENCE) ** 2))
    r = surface.com - vertices
    off_axis = np.linalg.norm(r - (r * axis).sum(axis=-1)[..., None] * axis, axis=-1)
    s_com = np.exp(-((off_axis / COM_SIGMA) ** 2))
    s_sep = np.clip(np.linalg.norm(wraps[:, 0] - wraps[:, 1], axis=-1) / SEPARATION, 0, 1)
    scores = s_w * s_t * s_k.mean(axis=1) * s_coh * s_com * s_sep
    valid = hit & surface.normals.any(axis=1)
    scores = np.where(valid, scores, 0.0)
    choice = np.argmax(scores, axis=0)
    seconds["scores"] = clock() - start
    return Result(
        surface=surface,
        score=scores.max(axis=0),
        valid=valid,
        opposing=opposing,
        opposing_normal=opposing_normal,
        hit_face=hit_face,
        long_axis=axes,
        eigenvalues=eigenvalues,
        wraps=wraps,
        scores=scores,
        choice=choice,
        seconds=seconds,
    )
