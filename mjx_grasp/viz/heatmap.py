"""Pictures of heatmaps: the coloured mesh, shaded, with a grasp triple and an anchor on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from PIL import Image, ImageDraw

from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.heatmap.sampling import Triples
from mjx_grasp.heatmap.steering import Heatmap
from mjx_grasp.viz.raster import Fragments, Orthographic, fitted, look_from, rasterise

Picture = UInt8[np.ndarray, "h w 3"]

THUMB, WRAP, ANCHOR = (235, 60, 40), (255, 255, 255), (255, 64, 200)
"""Colours of the marks: none of them is on the scale."""
BACKGROUND = (255, 255, 255)
_INK = (25, 25, 35)
_SUPERSAMPLING = 2
_ELEVATION = np.radians(24.0)
# Three of each quarter: along an axis a box is a flat rectangle, and its sides are unseen.
_AZIMUTHS = np.radians([90.0 * k + turn for k in range(4) for turn in (22.5, 45.0, 67.5)])
_JUDGED_PIXELS = 72  # side of the pictures on which a view is judged
_CREASE = 0.75  # cosine between a face's and a vertex's normal below which an edge stays sharp
_HIDDEN_M = 0.003  # a mark this far behind the visible surface is on the far side


@dataclass(frozen=True, eq=False)
class Subject:
    """What is drawn: a mesh with scores, and marks on it. Metres, object frame."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    score: Float[np.ndarray, " v"]
    """Not a number where there is no candidate."""
    thumb: Float[np.ndarray, " 3"] | None = None
    wrap: Float[np.ndarray, "2 3"] | None = None
    anchor: Float[np.ndarray, " 3"] | None = None


def subject_of(
    heatmap: Heatmap,
    faces: Int[np.ndarray, "f 3"],
    score: Float[Array, " v"] | Float[np.ndarray, " v"] | None = None,
    triple: Triples | None = None,
    anchor: Float[np.ndarray, " 3"] | None = None,
) -> Subject:
    """A heatmap as what is drawn.

    Args:
        heatmap: Candidates, one per vertex.
        faces: Vertex indices.
        score: Other scores than the heatmap's own.
        triple: Its first row is drawn, if it is valid.
        anchor: A point to mark [m].
    """
    score = np.asarray(heatmap.score if score is None else score, np.float64)
    shown = triple is not None and bool(triple.valid[0])
    return Subject(
        vertices=np.asarray(heatmap.vertices, np.float64),
        faces=np.asarray(faces),
        normals=np.asarray(heatmap.normals, np.float64),
        score=np.where(np.asarray(heatmap.valid), score, np.nan),
        thumb=np.asarray(triple.thumb[0], np.float64) if shown and triple else None,
        wrap=np.asarray(triple.wrap[0], np.float64) if shown and triple else None,
        anchor=None if anchor is None else np.asarray(anchor, np.float64),
    )


def best_axes(subject: Subject) -> Float[np.ndarray, "3 3"]:
    """The side from which most of the good surface, the thumb and the pair of wraps are seen."""
    views = [look_from(azimuth, _ELEVATION) for azimuth in _AZIMUTHS]
    return max(views, key=lambda axes: _judge(subject, axes))


def draw(
    subject: Subject,
    width: int,
    height: int,
    axes: Float[np.ndarray, "3 3"] | None = None,
    top: float = 1.0,
) -> Picture:
    """A picture of the subject.

    Filled marks are contacts on the near side, rings are contacts on the far side, seen through
    the object; a line joins the thumb with the middle of the wraps.

    Args:
        subject: What is drawn.
        width: Pixels.
        height: Pixels.
        axes: Camera axes, see :func:`~mjx_grasp.viz.raster.look_from`; the best side if None.
        top: The score that gets the yellow end of the scale.
    """
    axes = best_axes(subject) if axes is None else axes
    k = _SUPERSAMPLING
    marks = [
        m.reshape(-1, 3) for m in (subject.thumb, subject.wrap, subject.anchor) if m is not None
    ]
    shown = np.concatenate([subject.vertices, *marks])
    camera = fitted(shown, axes, k * width, k * height)
    fragments = rasterise(subject.vertices, subject.faces, camera)
    image = Image.fromarray(_shaded(subject, fragments, camera, top))
    _draw_marks(ImageDraw.Draw(image, "RGBA"), subject, fragments, camera)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def _shaded(subject: Subject, seen: Fragments, camera: Orthographic, top: float) -> Picture:
    drawn = seen.face >= 0
    face, weights = seen.face[drawn], seen.weights[drawn]
    corners = subject.faces[face]
    score = (subject.score[corners] * weights).sum(axis=1)
    normal = (_corner_normals(subject)[face] * weights[..., None]).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal = normal @ camera.axes.T
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0)  # an inner wall is lit like an outer one
    # From over the viewer's left shoulder; soft, so that the colours keep their meaning.
    light = np.array([-0.45, 0.55, 0.70]) / np.linalg.norm([-0.45, 0.55, 0.70])
    lambert = np.maximum(normal @ light, 0.0)
    brightness = 0.62 + 0.38 * lambert
    gloss = 26.0 * np.maximum(lambert, 0.0) ** 24
    colours = score_colours(score, top) * brightness[:, None] + gloss[:, None]
    picture = np.empty((*seen.face.shape, 3), np.uint8)
    picture[:] = BACKGROUND
    picture[drawn] = np.clip(colours, 0, 255).astype(np.uint8)
    return picture


def _corner_normals(subject: Subject) -> Float[np.ndarray, "f 3 3"]:
    """Normals at the corners of faces: smooth, except across creases."""
    corners = subject.vertices[subject.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
    smooth = subject.normals[subject.faces]
    crease = (smooth * flat[:, None]).sum(axis=2) < _CREASE
    return np.where(crease[..., None], flat[:, None], smooth)


def _draw_marks(
    pen: ImageDraw.ImageDraw, subject: Subject, seen: Fragments, camera: Orthographic
) -> None:
    unit = min(camera.width, camera.height) / 100.0
    if subject.thumb is not None and subject.wrap is not None:
        thumb, first, second = camera.project(np.stack([subject.thumb, *subject.wrap]))
        middle = 0.5 * (first + second)
        for start, end in ((thumb, middle), (first, second)):
            line = [(start[0], start[1]), (end[0], end[1])]
            pen.line(line, fill=(*_INK, 150), width=round(1.6 * unit))
            pen.line(line, fill=(255, 255, 255, 210), width=round(0.8 * unit))
        for point, colour in ((first, WRAP), (second, WRAP), (thumb, THUMB)):
            _disc(pen, point, 2.4 * unit, colour, _hidden(point, seen))
    if subject.anchor is not None:
        _cross(pen, camera.project(subject.anchor), 3.4 * unit)


def _cross(pen: ImageDraw.ImageDraw, point: Float[np.ndarray, " 3"], reach: float) -> None:
    x, y, _ = point
    white, colour = (255, 255, 255, 230), (*ANCHOR, 255)
    for r, width, ink in ((1.06 * reach, 0.68 * reach, white), (reach, 0.4 * reach, colour)):
        for sign in (-1, 1):
            pen.line([(x - r, y - sign * r), (x + r, y + sign * r)], ink, round(width))


def _disc(
    pen: ImageDraw.ImageDraw,
    point: Float[np.ndarray, " 3"],
    radius: float,
    colour: tuple[int, int, int],
    hidden: bool,
) -> None:
    x, y, _ = point

    def box(r: float) -> tuple[float, float, float, float]:
        return (x - r, y - r, x + r, y + r)

    if hidden:
        pen.ellipse(box(1.15 * radius), outline=(*_INK, 255), width=round(0.75 * radius))
        pen.ellipse(box(radius), outline=(*colour, 255), width=round(0.45 * radius))
    else:
        pen.ellipse(box(1.15 * radius), fill=(*_INK, 255))
        pen.ellipse(box(0.85 * radius), fill=(*colour, 255))


def _hidden(point: Float[np.ndarray, " 3"], seen: Fragments) -> bool:
    height, width = seen.near.shape
    x, y = int(np.clip(point[0], 0, width - 1)), int(np.clip(point[1], 0, height - 1))
    return bool(point[2] < seen.near[y, x] - _HIDDEN_M)


def _judge(subject: Subject, axes: Float[np.ndarray, "3 3"]) -> float:
    camera = fitted(subject.vertices, axes, _JUDGED_PIXELS, _JUDGED_PIXELS)
    seen = rasterise(subject.vertices, subject.faces, camera)
    drawn = seen.face >= 0
    if not drawn.any():
        return 0.0
    score = np.nan_to_num(subject.score)[subject.faces].mean(axis=1)
    # The share of the good surface that is seen, however small a part of the mesh it is.
    a, b, c = np.moveaxis(subject.vertices[subject.faces], 1, 0)
    whole = float((0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1) * score).sum())
    shown = float(score[seen.face[drawn]].sum()) / camera.pixels_per_metre**2
    worth = 2.0 * shown / max(whole, 1e-12) + 0.5 * float(drawn.mean())
    if subject.thumb is not None and subject.wrap is not None:
        thumb, *wraps = camera.project(np.stack([subject.thumb, *subject.wrap]))
        worth += 0.0 if _hidden(thumb, seen) else 0.5
        # Contacts far apart in the picture are told from each other.
        gaps = [np.hypot(*(a - b)[:2]) for a, b in ((thumb, wraps[0]), (thumb, wraps[1]), wraps)]
        worth += 1.2 * min(min(gaps) / _JUDGED_PIXELS, 0.25)
    return worth
