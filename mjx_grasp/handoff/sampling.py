"""Where objects lie on the table, and which heatmap candidates are tried on them (method §4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.objects.model import ObjectModel, RestingPose


def poses_at_rest(obj: ObjectModel, standing: float) -> tuple[RestingPose, ...]:
    """An object's resting poses, with a share of it standing as it was scanned.

    What falls at random hardly ever ends on its small base, but is put there: a can is to be
    grasped from the side too.

    Args:
        obj: The object; with a share above 0 one that stands as scanned, its z axis up.
        standing: Share of the poses that stand so [-].
    """
    if standing == 0:
        return obj.resting
    height = -float(obj.mesh.bounds[0, 2])
    upright = RestingPose(np.array([1.0, 0.0, 0.0, 0.0]), height, standing)
    total = sum(pose.probability for pose in obj.resting)
    fallen = (
        replace(pose, probability=(1 - standing) * pose.probability / total) for pose in obj.resting
    )
    return (upright, *fallen)


def sample_object_poses(
    resting: Sequence[RestingPose], count: int, config: SamplingConfig, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Object poses at rest on the table: position in [m] and quaternion w-x-y-z, world.

    The resting pose by its probability, x, y and yaw uniform in the object area.

    Args:
        resting: Resting poses of the object.
        count: Poses wanted.
        config: The object area.
        rng: Source of randomness.
    """
    share = np.array([pose.probability for pose in resting])
    which = rng.choice(len(resting), size=count, p=share / share.sum())
    height = np.array([pose.height for pose in resting])[which]
    w, x, y, z = np.array([pose.quat for pose in resting])[which].T
    half = 0.5 * rng.uniform(-np.pi, np.pi, count)
    c, s = np.cos(half), np.sin(half)
    # The turn about the world's z after the resting rotation: (c, 0, 0, s) · quat.
    quat = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1)
    position = np.stack(
        [rng.uniform(*config.area.x, count), rng.uniform(*config.area.y, count), height], axis=1
    )
    return position, quat / np.linalg.norm(quat, axis=1, keepdims=True)


def rotation_matrix(quat: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """Of a quaternion w-x-y-z, in double precision."""
    w, x, y, z = quat.astype(np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def draw_candidates(
    score: Float[np.ndarray, " v"],
    area: Float[np.ndarray, " v"],
    thumb: Float[np.ndarray, "v 3"],
    allowed: Bool[np.ndarray, " v"],
    config: SamplingConfig,
    rng: np.random.Generator,
) -> Int[np.ndarray, " n"]:
    """Candidates for one object pose: good ones more often, no two close together.

    A draw without replacement with weights area · exp(score/temperature) (the Gumbel trick),
    thinned so that thumb contacts keep their distance. With the areas it is a draw of points of the
    surface: where the mesh is dense there are more candidates, not more draws. May return fewer
    than asked, or none.

    Args:
        score: Heatmap scores.
        area: Of the surface around each candidate [m²].
        thumb: Thumb contacts in [m].
        allowed: Which candidates may be used at this pose.
        config: Number, temperature, distance.
        rng: Source of randomness.
    """
    share = np.log(np.maximum(area, np.finfo(np.float64).tiny))
    keys = score / config.temperature + share + rng.gumbel(size=len(score))
    order = np.flatnonzero(allowed)
    order = order[np.argsort(-keys[order], kind="stable")]
    chosen: list[int] = []
    for index in order:
        gap = np.linalg.norm(thumb[chosen] - thumb[index], axis=1)
        if not chosen or gap.min() >= config.min_distance:
            chosen.append(int(index))
            if len(chosen) == config.candidates_per_pose:
                break
    return np.array(chosen, dtype=np.int64)
