"""Where package and oracle differ, and why: each difference is put into a class, automatically.

A class is a decision that rounding may take either way: in each, the two candidates of the
decision are compared in double precision, and only if they are within float32's reach of each
other (`REACH`, `SHARE`) is the difference explained by it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import oracle

AGREE = 1e-4
"""Scores closer than this agree."""
REACH = 1e-7
"""m. Positions in float32 on these meshes, a few times over."""
SHARE = 1e-3
"""Relative: eigenvalues and scores that follow from such positions."""
SAME = 1e-6
"""m. Points closer than this are the same decision."""

CLASSES = (
    "edge hit",
    "ray threshold",
    "neighbourhood rim",
    "eigenvalue tie",
    "principal axis tie",
    "face tie",
    "offset tie",
)


@dataclass
class Comparison:
    """Agreement of one heatmap with the oracle's."""

    vertices: int
    agree: int
    max_difference: float
    classes: dict[str, int]
    """How many of the others are of which class; 'unexplained' must not occur."""
    unexplained: list[int]

    @property
    def share(self) -> float:
        return self.agree / self.vertices


def compare(heatmap, result: oracle.Result) -> Comparison:
    """Compares the scores, and explains each vertex that does not agree."""
    score = np.asarray(heatmap.score, float)
    difference = np.abs(score - result.score)
    bad = np.flatnonzero(difference > AGREE)
    reasons = {int(i): explain(heatmap, result, i) for i in bad}
    return Comparison(
        vertices=len(score),
        agree=len(score) - len(bad),
        max_difference=float(difference.max()),
        classes=dict(Counter(reasons.values())),
        unexplained=[i for i, reason in reasons.items() if reason == "unexplained"],
    )


def explain(heatmap, result: oracle.Result, i: int) -> str:
    """The first decision on the way to the score that went the other way, if it was close."""
    surface = result.surface
    found = {name: np.asarray(getattr(heatmap, name)[i], float) for name in FIELDS}
    # A different opposing contact?
    if np.linalg.norm(found["opposing"] - result.opposing[i]) > SAME:
        return _about_the_ray(surface, found["opposing"], result, i)
    across = np.linalg.norm(np.cross(found["long_axis"], result.long_axis[i]))
    if across > 1e-5:
        return _about_the_axis(surface, result, i)
    h = int(np.argmin(np.abs(oracle.OFFSETS - found["offset"])))
    sides = result.wraps[h, :, i]
    pairs = found["wrap"], found["wrap"][::-1]
    wrap = min(pairs, key=lambda pair: np.abs(pair - sides).max())
    signs = np.array([[1.0], [-1.0]])
    seeds = result.opposing[i] + oracle.OFFSETS[h] * signs * result.long_axis[i]
    apart = np.linalg.norm(wrap - sides, axis=1)
    if apart.max() > 1e-2 * SAME:
        near = np.linalg.norm(wrap - seeds, axis=1) - np.linalg.norm(sides - seeds, axis=1)
        return "face tie" if np.abs(near).max() < REACH else "unexplained"
    scores = result.scores[:, i]
    if h != result.choice[i] and scores[h] >= (1 - SHARE) * scores.max():
        return "offset tie"
    return "unexplained"


FIELDS = ("opposing", "long_axis", "offset", "wrap")


def _about_the_ray(surface, opposing, result, i) -> str:
    origin, direction = surface.mesh.vertices[i], -surface.normals[i]
    least = 1e-4 * surface.diagonal
    distances = [
        (opposing - origin) @ direction,
        (result.opposing[i] - origin) @ direction,
    ]
    if min(abs(d - least) for d in distances) < REACH:
        return "ray threshold"
    # The farther of the two hits is on an edge: some caster saw it, and some did not.
    point = origin + max(distances) * direction
    corners = surface.mesh.vertices[surface.mesh.faces]
    sides = np.roll(corners, -1, axis=1) - corners
    lengths = np.maximum((sides * sides).sum(axis=-1), 1e-30)
    along = np.clip(((point - corners) * sides).sum(axis=-1) / lengths, 0, 1)
    gap = np.linalg.norm(corners + along[..., None] * sides - point, axis=-1)
    return "edge hit" if gap.min() < SAME else "unexplained"


def _about_the_axis(surface, result, i) -> str:
    large, small = result.eigenvalues[i]
    if large < 1e-12:
        close = False
    else:
        close = abs((large - small) / large - oracle.ISOTROPY) < SHARE
        close |= abs(large / oracle.FLATNESS - 1) < SHARE
    if close:
        return "eigenvalue tie"
    point, normal = result.opposing[i], result.opposing_normal[i]
    facing = surface.face_normals @ normal
    area = surface.areas > 0
    centroids = surface.mesh.vertices[surface.mesh.faces].mean(axis=1)
    distance = np.linalg.norm(centroids - point, axis=1)
    alike = np.sort(distance[area & (facing > 0)])
    radius = oracle.RADIUS
    if (alike <= radius).sum() < oracle.FEWEST <= len(alike):
        radius = alike[oracle.FEWEST - 1]
        if len(alike) > oracle.FEWEST and alike[oracle.FEWEST] - radius < REACH:
            return "neighbourhood rim"
    near = area & (distance < radius + SAME)
    on_rim = near & (facing > 0) & (np.abs(distance - radius) < REACH)
    square = near & (np.abs(facing) < 2e-5)
    if on_rim.any() or square.any():
        return "neighbourhood rim"
    lean = np.arccos(np.clip(abs(surface.axes[0] @ normal), 0, 1))
    equal = np.abs(np.diff(surface.moments)).min() < 1e-5 * surface.moments[0]
    vague = large < oracle.FLATNESS or large - small <= oracle.ISOTROPY * large
    if vague and (abs(lean - oracle.PARALLEL) < 1e-5 or equal):
        return "principal axis tie"
    return "unexplained"
