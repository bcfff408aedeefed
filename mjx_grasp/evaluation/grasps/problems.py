"""Where objects stand in the trials of whole grasps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.rollout import GraspProblem
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.sampling import poses_at_rest, sample_object_poses
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.state import Known

_DRAWS = 20
"""Poses drawn for each that is wanted, and for ten more, where they are to be away from
something."""


class Away(NamedTuple):
    """Where objects are not to be."""

    point: Float[np.ndarray, " 3"]
    """world frame [m]"""
    distance: float
    """least of their origins from it [m]"""


def draw_problem(
    objects: Sequence[ObjectModel],
    trials: int,
    seed: int,
    config: SamplingConfig | None = None,
    away: Away | None = None,
) -> GraspProblem:
    """Random poses at rest on the table, as start states are sampled (method §4).

    An object's poses depend on the seed and its own place in the list of none other.

    Args:
        objects: Those of the scene, in its order.
        trials: Poses of each.
        seed: Of the poses.
        config: The object area, and how many stand as scanned.
        away: From where they keep away.

    Raises:
        InputError: They can lie nowhere else.
    """
    config = config or SamplingConfig()
    drawn = []
    for obj in objects:
        rng = np.random.default_rng([seed, int(obj.content_hash[:8], 16)])
        resting = poses_at_rest(obj, config.standing)
        wanted = trials if away is None else _DRAWS * (trials + 10)
        p_wo, quat = sample_object_poses(resting, wanted, config, rng)
        if away is not None:
            kept = np.linalg.norm(p_wo - away.point, axis=1) >= away.distance
            p_wo, quat = p_wo[kept][:trials], quat[kept][:trials]
            if len(p_wo) < trials:
                raise InputError("away", away.distance, "less: the object area ends before [m]")
        drawn.append((p_wo, quat))
    return GraspProblem(
        object_index=np.repeat(np.arange(len(objects)), trials),
        p_wo=np.concatenate([p for p, _ in drawn]).astype(np.float32),
        quat=np.concatenate([quat for _, quat in drawn]).astype(np.float32),
    )


def known_of(known: Sequence[Known], problem: GraspProblem) -> Known:
    """What is known of each trial's object, stacked.

    Args:
        known: Of the scene's objects, in its order.
        problem: The trials.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *known)
    return jax.tree.map(lambda leaf: leaf[problem.object_index], stacked)
