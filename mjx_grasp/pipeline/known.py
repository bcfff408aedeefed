"""What a grasp has to know of an object: its candidates, by default and near an anchor."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.packing import filled_size
from mjx_grasp.grasp.candidates import (
    Candidates,
    check_scores,
    evenly_over_directions,
    first_and_rest,
    vertex_candidates,
)
from mjx_grasp.grasp.levered import THIN_M, levered
from mjx_grasp.heatmap.compute import heatmap_of, heatmaps_of
from mjx_grasp.heatmap.steering import Heatmap
from mjx_grasp.objects.clearance import collision_field
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.state import Known
from mjx_grasp.robot.description import HandSpec, RobotSpec

CANDIDATES = 1024
"""Of a heatmap, among which reaching chooses: of a flat object or a small ball few are high enough
above the table for the hand, whatever their score."""
STEERED_CANDIDATES = 2048
"""The same where scores are steered: the anchor's best three quarters and others of the heatmap, as
the object may lie on most of the former."""
LEVERED = 512
"""Further ones where walls are thin, with the thumb higher or lower than the wraps."""
STEERED_SCORE = 0.5
"""With less a candidate is not chosen where scores are steered [-]."""
STEERED_AT_LEAST = (32, 128, 512)
"""So many of those that can be used where the object lies are looked at, one number after the other
where there is no good posture; one or two are seldom within reach [-]."""


_SAME_M = 1e-3  # between the boxes of an object and of its heatmap
_UPS = 4  # directions that may be upwards, for each of which these are made


def known_object(
    obj: ObjectModel,
    robot: RobotSpec,
    heatmap: Heatmap | None = None,
    score: Float[Array | np.ndarray, " v"] | None = None,
) -> Known:
    """What a grasp has to know of an object; of one size for all objects, so that they stack.

    Its candidates are the best by score, and a quarter others, for poses in which none of those is
    within reach; and further ones of thin walls, see `levered`.

    Args:
        obj: The object.
        robot: Whose hand the candidates are for.
        heatmap: Of the object; computed here if None.
        score: Of an anchor, see `steered_candidates`; the heatmap's own if None.

    Raises:
        InputError: The heatmap is of another object or frame, or the scores of another heatmap.
    """
    if heatmap is None:
        heatmap = heatmap_of(obj, robot.hand)
    else:
        _check_of(obj, heatmap)
    if score is None:
        candidates = _own(*_filled(heatmap, heatmap.score), _hanging(obj), CANDIDATES)
    else:
        check_scores(heatmap, score)
        candidates = steered_candidates(heatmap, score, obj=obj)
    weight, com = jnp.float32(obj.weight), jnp.asarray(obj.com, jnp.float32)
    return Known(collision_field(obj), candidates, weight, com)


def _check_of(obj: ObjectModel, heatmap: Heatmap) -> None:
    """Refuses a heatmap whose surface is somewhere else than the object's.

    Raises:
        InputError: It is.
    """
    vertices = np.asarray(heatmap.vertices)
    found = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    if not np.allclose(found, obj.mesh.bounds, atol=_SAME_M):
        there, own = (_box(corners) for corners in (found, obj.mesh.bounds))
        expected = f"one of {obj.name} in the object frame, from {own}"
        raise InputError("heatmap", f"one of a surface from {there}", expected)


def _box(corners: Float[np.ndarray, "2 3"]) -> str:
    low, high = (", ".join(f"{x:.3f}" for x in corner) for corner in corners)
    return f"({low}) to ({high}) m"


def known_objects(objects: Sequence[ObjectModel], robot: RobotSpec) -> list[Known]:
    """`known_object` of several, whose heatmaps are worked out together: sooner than one by one."""
    heatmaps = heatmaps_of(objects, robot.hand)
    return [known_object(obj, robot, h) for obj, h in zip(objects, heatmaps, strict=True)]


def check_graspable(name: str, best: float, hand: HandSpec, least: float = 0.0) -> None:
    """Refuses an object before anything long starts.

    Args:
        name: Of the object.
        best: Its best score.
        hand: That is to grasp it.
        least: Score that does not count as a grasp yet.

    Raises:
        InputError: Nothing of it has a better score.
    """
    if best <= least:
        narrow, wide = (1e3 * length for length in hand.span)
        raise InputError(
            "object",
            name,
            f"one with a place {narrow:.0f} to {wide:.0f} mm wide for thumb and fingers to oppose",
        )


def steered_candidates(
    heatmap: Heatmap,
    score: Float[Array | np.ndarray, " v"],
    obj: ObjectModel | None = None,
) -> Candidates:
    """Those a steered grasp chooses among: the anchor's best, with `steered_scores`.

    A quarter are others, the best of the heatmap itself in all directions, for when nothing near
    the anchor is within reach. Not for use under `jit`: arrays are filled up on the host.

    Args:
        heatmap: Of the object.
        score: Of its vertices, by an anchor.
        obj: The object, for further ones of its thin walls; none without it.
    """
    hanging = None if obj is None else _hanging(obj)
    return _steered(*_filled(heatmap, score), hanging, STEERED_CANDIDATES, STEERED_AT_LEAST[0])


class _Hanging(NamedTuple):
    """What makes an object turn that hangs on a thin wall; object frame."""

    com: Float[Array, " 3"]
    """[m]"""
    ups: Float[Array, "u 3"]
    """unit directions that may be upwards: as it was scanned, and as it rests most often"""


def _hanging(obj: ObjectModel) -> _Hanging:
    likely = sorted(obj.resting, key=lambda pose: -pose.probability)
    quats = [[1.0, 0.0, 0.0, 0.0], *(likely[k % len(likely)].quat for k in range(_UPS - 1))]
    turns = so3.quat_to_mat(jnp.asarray(np.array(quats, np.float32)))
    return _Hanging(jnp.asarray(obj.com, jnp.float32), turns[:, 2])


@partial(jax.jit, static_argnames="count")
def _own(heatmap: Heatmap, score: Float[Array, " v"], hanging: _Hanging, count: int) -> Candidates:
    """By the heatmap's own scores; thin walls in all directions, as it may lie on the best."""
    surface = vertex_candidates(heatmap, score)
    thin = jnp.where(surface.width <= THIN_M, surface.score, 0.0)
    bases = evenly_over_directions(surface._replace(score=thin))[: LEVERED // _UPS]
    straight = first_and_rest(heatmap, score, count - count // 4, count)
    return _with_levered(straight, surface, bases, hanging)


@partial(jax.jit, static_argnames=("count", "at_least"))
def _steered(
    heatmap: Heatmap,
    score: Float[Array, " v"],
    hanging: _Hanging | None,
    count: int,
    at_least: int,
) -> Candidates:
    """By an anchor's; of the thin walls the nearest to it."""
    scores = steered_scores(heatmap, score, at_least)
    straight = first_and_rest(heatmap, scores, count - count // 4, count, rest_scored=True)
    if hanging is None:
        return straight
    surface = vertex_candidates(heatmap, scores)
    thin = jnp.where(surface.width <= THIN_M, surface.score, 0.0)
    _, bases = jax.lax.top_k(thin, LEVERED // _UPS)
    return _with_levered(straight, surface, bases, hanging)


def _with_levered(
    straight: Candidates, surface: Candidates, bases: Int[Array, " b"], hanging: _Hanging
) -> Candidates:
    made = levered(jax.tree.map(lambda leaf: leaf[bases], surface), surface, *hanging)
    return jax.tree.map(lambda *both: jnp.concatenate(both), straight, made)


def _filled(
    heatmap: Heatmap, score: Float[Array | np.ndarray, " v"]
) -> tuple[Heatmap, Float[Array, " w"]]:
    """Filled up with what is no candidate, so that not every object compiles for itself."""
    more = filled_size(len(score)) - len(score)

    def filled(leaf: Array | np.ndarray) -> Array:  # on the host: on the device each size compiles
        rows = np.pad(np.asarray(leaf), [(0, more)] + [(0, 0)] * (leaf.ndim - 1))
        return jnp.asarray(rows)

    return jax.tree.map(filled, (heatmap, score))


def steered_scores(
    heatmap: Heatmap, score: Float[Array, " v"], at_least: int = STEERED_AT_LEAST[0]
) -> Float[Array, " v"]:
    """Steered scores on a scale on which those count that reach `STEERED_SCORE`.

    These are all from half of the best one, and no fewer than some, if there are as many at all.

    Args:
        heatmap: Of the object.
        score: Of its vertices, by an anchor.
        at_least: So many.
    """
    ranked = jnp.sort(jnp.where(heatmap.valid, score, 0.0))[::-1]
    least = ranked[jnp.clip(jnp.sum(ranked > 0), 1, at_least) - 1] / STEERED_SCORE
    top = jnp.clip(least, 1e-6 * ranked[0], ranked[0])
    return jnp.minimum(score / jnp.maximum(top, 1e-30), 1.0)
