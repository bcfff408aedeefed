"""Stable resting poses of an object on a table, from the facets of its hull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from mjx_grasp.objects.convex import Piece
from mjx_grasp.records.settings import Count, NonNegative, Settings, Share


@dataclass(frozen=True)
class RestingConfig(Settings):
    """Which resting poses count, and how many."""

    min_probability: Share = 0.03
    """of coming to rest like this [-]"""
    max_poses: Count = 12
    """at most; a can on its side alone takes about eight [-]"""
    min_margin: NonNegative = 0.0015
    """from the centre of mass's foot to the edge of the support [m]"""
    merge_angle: NonNegative = 0.44
    """resting directions closer than this are one pose [rad]"""
    touching: NonNegative = 0.0002
    """points this close to a facet's plane support it [m]"""
    same_face: NonNegative = 0.06
    """facets this close are one face, whose corners the hull has cut [rad]"""


@dataclass(frozen=True)
class RestingPose:
    """A pose in which the object rests on the table z = 0."""

    quat: Float[np.ndarray, "4"]
    """object to world, w-x-y-z; the least rotation that puts the facet down (yaw is free)"""
    height: float
    """world z of the object frame's origin [m]"""
    probability: float
    """of coming to rest like this after a slow, random drop [-]"""


def resting_poses(
    pieces: tuple[Piece, ...],
    com: Float[np.ndarray, "3"],
    config: RestingConfig = RestingConfig(),
) -> tuple[RestingPose, ...]:
    """Resting poses of the pieces' common hull, the most probable first.

    Quasi-static: the object lands on a facet with the probability of the facet's solid angle seen
    from the centre of mass, and topples over the edge that the centre of mass lies beyond, until
    it is above the facet. Directions within ``merge_angle`` of a more probable one are merged with
    it, so that the many facets of a can's side become a few poses.
    """
    if len(pieces) == 1 and pieces[0].kind == "sphere":
        return (_ball_pose(pieces[0], com),)
    points = np.concatenate([_support(piece) for piece in pieces])
    hull = ConvexHull(points)
    normals = hull.equations[:, :3]
    corners = points[hull.simplices]
    final = _topple(hull, corners, normals, com)
    landing = _solid_angle(corners - com) / (4.0 * np.pi)
    probability = np.bincount(final, weights=landing, minlength=len(normals))
    margin = np.array(
        [
            _margin(_supporting(hull, f, config), normals[f], com) if p > 0 else -np.inf
            for f, p in enumerate(probability)
        ]
    )
    stable = margin >= min(config.min_margin, margin.max())
    poses = []
    for facet, share in _merged(normals, probability, stable, config.merge_angle):
        quat = _turning_down(normals[facet])
        lowest = _lowest(pieces, quat)
        poses.append(RestingPose(quat, -lowest, share))
    kept = [pose for pose in poses if pose.probability >= config.min_probability]
    return tuple((kept or poses[:1])[: config.max_poses])


def rotate(quat: Float[np.ndarray, "4"], points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Rotates points by a unit quaternion w-x-y-z."""
    w, v = quat[0], quat[1:]
    twice = 2.0 * np.cross(v, points)
    return points + w * twice + np.cross(v, twice)


def _support(piece: Piece) -> np.ndarray:
    if piece.kind == "sphere":
        return np.asarray(piece.surface().vertices)
    return piece.vertices


def _ball_pose(ball: Piece, com: np.ndarray) -> RestingPose:
    """A ball rests with its centre of mass below its centre."""
    offset = com - ball.pos
    size = float(np.linalg.norm(offset))
    quat = _turning_down(offset / size) if size > 1e-5 else np.array([1.0, 0.0, 0.0, 0.0])
    return RestingPose(quat, -_lowest((ball,), quat), 1.0)


def _lowest(pieces: tuple[Piece, ...], quat: np.ndarray) -> float:
    lowest = np.inf
    for piece in pieces:
        points = piece.pos[None] if piece.kind == "sphere" else piece.vertices
        lowest = min(lowest, float(rotate(quat, points)[:, 2].min()) - piece.radius)
    return lowest


def _turning_down(direction: np.ndarray) -> np.ndarray:
    """The least rotation (w-x-y-z) that takes a unit direction to world -z."""
    down = np.array([0.0, 0.0, -1.0])
    cosine = float(direction @ down)
    if cosine < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quat = np.concatenate([[1.0 + cosine], np.cross(direction, down)])
    return quat / np.linalg.norm(quat)


def _topple(
    hull: ConvexHull, corners: np.ndarray, normals: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """The facet on which the object comes to rest after landing on each facet."""
    # Edge k lies opposite corner k, as qhull's neighbours do; how far beyond it is the com's foot?
    beyond = np.empty((len(normals), 3))
    for k in range(3):
        start, end = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        outward = np.cross(end - start, normals)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
        outward *= -np.sign(((corners[:, k] - start) * outward).sum(axis=1, keepdims=True))
        beyond[:, k] = ((com - start) * outward).sum(axis=1)
    rolls = beyond.max(axis=1) > 1e-9
    following = np.where(
        rolls, hull.neighbors[np.arange(len(normals)), beyond.argmax(axis=1)], np.arange(len(rolls))
    )
    final = np.arange(len(normals))
    for _ in range(len(normals)):  # each step lowers the com, so that no path is longer
        moved = following[final]
        if (moved == final).all():
            break
        final = moved
    return final


def _solid_angle(corners: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(corners, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    denominator = la * lb * lc
    denominator += (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return 2.0 * np.abs(np.arctan2((a * np.cross(b, c)).sum(1), denominator))


def _supporting(hull: ConvexHull, facet: int, config: RestingConfig) -> np.ndarray:
    """Points that carry the object on a facet.

    A hull with few vertices can turn a flat face into several facets, tilted by a few
    degrees: the object rocks between them, but it does not leave the face.
    """
    normal, offset = hull.equations[facet, :3], hull.equations[facet, 3]
    touching = hull.points[hull.vertices] @ normal + offset > -config.touching
    flat = hull.equations[:, :3] @ normal > np.cos(config.same_face)
    return hull.points[np.union1d(hull.vertices[touching], hull.simplices[flat])]


def _margin(support: np.ndarray, normal: np.ndarray, com: np.ndarray) -> float:
    """Distance (m) of the com's foot from the edge of the points that carry the object."""
    axes = np.linalg.svd(normal[None])[2][1:]
    try:
        polygon = ConvexHull(support @ axes.T).equations
    except Exception:  # a support without area carries nothing
        return -np.inf
    return float(-(polygon[:, :2] @ (axes @ com) + polygon[:, 2]).max())


def _merged(
    normals: np.ndarray, probability: np.ndarray, stable: np.ndarray, angle: float
) -> list[tuple[int, float]]:
    """Representative facets and their summed probabilities, the most probable first."""
    candidates = np.nonzero(stable & (probability > 0))[0]
    candidates = candidates[np.argsort(-probability[candidates], kind="stable")]
    chosen: list[int] = []
    for facet in candidates:
        if all(normals[facet] @ normals[other] < np.cos(angle) for other in chosen):
            chosen.append(int(facet))
    shares = np.zeros(len(chosen))
    for facet in np.nonzero(probability > 0)[0]:
        shares[int(np.argmax(normals[chosen] @ normals[facet]))] += probability[facet]
    order = np.argsort(-shares, kind="stable")
    return [(chosen[i], float(shares[i])) for i in order]
