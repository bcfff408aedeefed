"""Convex pieces of a mesh: a sphere, one hull, or an approximate decomposition by coacd."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import trimesh
from jaxtyping import Float

from mjx_grasp.objects.hulls import hull_mesh, reduced_hull
from mjx_grasp.objects.repair import split
from mjx_grasp.objects.surface import outside_distance, sample_surface
from mjx_grasp.records.settings import Count, NonNegative, Range, Seed, Settings

_TRIED, _LEAST_TRIED = 4096, 4
"""Hulls that are tried for each of n components, times n; and at least so many."""


@dataclass(frozen=True)
class Division(Settings):
    """How finely coacd divides."""

    max_pieces: Count = 12
    """pieces of an object at most [-]"""
    threshold: Annotated[float, Range(0, 1, above=True)] = 0.1
    """concavity that is left [-]"""
    iterations: Count = 150
    """of the search for each cut [-]"""
    depth: Count = 3
    """cuts that it looks ahead [-]"""


@dataclass(frozen=True)
class ConvexConfig(Settings):
    """How a mesh is divided into convex pieces."""

    single_hull_error: NonNegative = 0.006
    """95 % outward error up to which one hull is enough [m]"""
    divisions: tuple[Division, ...] = (
        Division(),
        Division(max_pieces=24, threshold=0.05, iterations=60, depth=2),
    )
    """tried in turn, until one stands out no farther than that; else the one that does least"""
    max_vertices: Annotated[int, Range(4, 2**31 - 1)] = 64
    """vertices of a hull at most [-]"""
    ball_deviation: NonNegative = 0.04
    """95 % radial deviation over the radius of what counts as a ball [-]"""
    samples: Count = 4000
    """surface points of the error estimate [-]"""
    seed: Seed = 0
    """of the points and the decomposition"""


@dataclass(frozen=True)
class Piece:
    """A convex piece of an object, in the object frame."""

    kind: str
    """'sphere' or 'hull'"""
    pos: Float[np.ndarray, "3"]
    """centre of the sphere; centroid of the hull's vertices [m]"""
    radius: float = 0.0
    """of the sphere; 0 for a hull [m]"""
    vertices: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """of the hull; empty for a sphere [m]"""

    def surface(self) -> trimesh.Trimesh:
        """A closed mesh of the piece; a sphere as a fine icosphere."""
        if self.kind == "sphere":
            ball = trimesh.creation.icosphere(subdivisions=4, radius=self.radius)
            return trimesh.Trimesh(ball.vertices + self.pos, ball.faces, process=False)
        return hull_mesh(self.vertices)

    def contains(self, points: Float[np.ndarray, "n 3"], tolerance: float = 0.0) -> np.ndarray:
        """Whether each point lies in the piece grown by ``tolerance`` (m)."""
        if self.kind == "sphere":
            return np.linalg.norm(points - self.pos, axis=1) <= self.radius + tolerance
        normals, offsets = self._planes()
        return (points @ normals.T + offsets).max(axis=1) <= tolerance

    def _planes(self) -> tuple[np.ndarray, np.ndarray]:
        mesh = hull_mesh(self.vertices)
        normals = np.asarray(mesh.face_normals)
        return normals, -(normals * mesh.triangles[:, 0]).sum(axis=1)


def convex_pieces(
    mesh: trimesh.Trimesh, config: ConvexConfig = ConvexConfig()
) -> tuple[tuple[Piece, ...], float]:
    """Divides a closed mesh into convex pieces.

    A ball becomes a sphere; a mesh whose reduced hull is off by at most ``single_hull_error``
    becomes that hull; everything else goes to coacd, component by component, with a fixed seed: a
    bowl's or a mug's thin wall in more pieces than others. There are never more than a division
    allows: of more components, small ones share a hull.

    Returns:
        The pieces and their 95 % outward error (m), see ``outward_error``.
    """
    ball = _ball(mesh, config)
    if ball is not None:
        return (ball,), outward_error(mesh, (ball,), config)
    hull, error = single_hull(mesh, config)
    if error <= config.single_hull_error:
        return (hull,), error
    best: tuple[tuple[Piece, ...], float] = (), float("inf")
    for division in config.divisions:
        pieces = _decomposed(mesh, division, config)
        best = min(best, (pieces, outward_error(mesh, pieces, config)), key=lambda found: found[1])
        if best[1] <= config.single_hull_error:
            break
    return best


def single_hull(
    mesh: trimesh.Trimesh, config: ConvexConfig = ConvexConfig()
) -> tuple[Piece, float]:
    """One hull of the whole mesh and its 95 % outward error (m)."""
    hull = _hull(np.asarray(mesh.vertices), config.max_vertices)
    return hull, outward_error(mesh, (hull,), config)


def outward_error(
    mesh: trimesh.Trimesh, pieces: tuple[Piece, ...], config: ConvexConfig = ConvexConfig()
) -> float:
    """95th percentile, over the surface of the pieces' union, of the distance outside the mesh (m).

    Points of the pieces' surface that lie inside the mesh count with distance 0.
    """
    surfaces = [piece.surface() for piece in pieces]
    triangles = np.concatenate([surface.triangles for surface in surfaces])
    owner = np.repeat(np.arange(len(pieces)), [len(surface.faces) for surface in surfaces])
    points, face = sample_surface(triangles, config.samples, config.seed)
    buried = np.zeros(len(points), bool)
    for k, piece in enumerate(pieces):
        buried |= (owner[face] != k) & piece.contains(points, tolerance=-1e-6)
    return float(np.percentile(outside_distance(mesh, points[~buried]), 95))


def _hull(points: np.ndarray, max_vertices: int) -> Piece:
    vertices = reduced_hull(points, max_vertices)
    return Piece("hull", vertices.mean(axis=0), 0.0, vertices)


def _ball(mesh: trimesh.Trimesh, config: ConvexConfig) -> Piece | None:
    """The least-squares sphere of the surface, if the surface is that round."""
    points, _ = sample_surface(np.asarray(mesh.triangles), config.samples, config.seed)
    system = np.concatenate([2.0 * points, np.ones((len(points), 1))], axis=1)
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))
    deviation = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
    full = 4.0 / 3.0 * np.pi * radius**3
    # A shallow bowl fits a sphere as well: only a ball also fills it.
    if np.percentile(deviation, 95) > config.ball_deviation * radius or mesh.volume < 0.8 * full:
        return None
    return Piece("sphere", centre, radius)


def _decomposed(
    mesh: trimesh.Trimesh, division: Division, config: ConvexConfig
) -> tuple[Piece, ...]:
    """At most ``max_pieces``: each component's own hull where that is enough, else coacd's."""
    parts = _gathered(split(mesh), division.max_pieces)
    hulls = [_hull(np.asarray(part.vertices), config.max_vertices) for part in parts]
    concave = np.array(
        [outward_error(mesh, (hull,), config) > config.single_hull_error for hull in hulls]
    )
    area = np.where(concave, [part.area for part in parts], 0.0)
    budget = division.max_pieces - int(np.sum(~concave))
    share = np.maximum(np.floor(budget * area / max(area.sum(), 1e-12)).astype(int), 1)
    # A component gets one piece however small its share: the largest shares give them up.
    while share[concave].sum() > budget:
        share[np.argmax(share)] -= 1
    pieces: list[Piece] = []
    for part, hull, count in zip(parts, hulls, share, strict=True):
        pieces += _coacd(part, int(count), division, config) if count > 1 else [hull]
    return tuple(pieces)


def _gathered(parts: list[trimesh.Trimesh], limit: int) -> list[trimesh.Trimesh]:
    """At most ``limit`` meshes of the components.

    While there are more, the one of the smallest hull joins that with which a common hull encloses
    the least volume besides the two; where there are very many, of the nearest by their boxes.
    """
    groups, hulls = [[part] for part in parts], [part.convex_hull for part in parts]
    volume = np.array([hull.volume for hull in hulls])
    low, high = np.stack([hull.bounds for hull in hulls], axis=1)
    while len(groups) > limit:
        k = int(np.argmin(volume))
        smallest, own, begin, end = groups.pop(k), hulls.pop(k), low[k], high[k]
        volume, low, high = (np.delete(of, k, axis=0) for of in (volume, low, high))
        gap = np.linalg.norm(np.maximum(np.maximum(low - end, begin - high), 0.0), axis=1)
        tried = max(_TRIED // len(groups), _LEAST_TRIED)
        near = np.argsort(gap, kind="stable")[:tried]
        common = [_joined([hulls[j], own]).convex_hull for j in near]
        best = int(np.argmin([both.volume for both in common] - volume[near]))
        j = int(near[best])
        groups[j] += smallest
        hulls[j], volume[j] = common[best], common[best].volume
        low[j], high[j] = common[best].bounds
    return [_joined(group) for group in groups]


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The components of all."""
    begin = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + k for part, k in zip(parts, begin, strict=False)])
    return trimesh.Trimesh(vertices, faces, process=False)


def _coacd(
    mesh: trimesh.Trimesh, count: int, division: Division, config: ConvexConfig
) -> list[Piece]:
    import coacd  # loads a native library: only where a decomposition is needed

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
        threshold=division.threshold,
        max_convex_hull=count,
        mcts_iterations=division.iterations,
        mcts_max_depth=division.depth,
        preprocess_mode="auto",
        decimate=False,
        seed=config.seed,
        real_metric=False,
    )
    pieces = []
    for vertices, _ in parts:
        try:
            pieces.append(_hull(np.asarray(vertices, dtype=np.float64), config.max_vertices))
        except ValueError:  # a sliver without volume carries no contact
            continue
    return pieces
