"""Where objects stand in the trials of whole grasps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.trials import GraspProblem
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.sampling import poses_at_rest, sample_object_poses
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.scene import Scene

_DRAWS = 20
"""Poses drawn at once for each that is wanted, and for ten more, where they are to be away from
something."""
_ROUNDS = 20
"""Times that poses are drawn until enough of them are clear."""


class Away(NamedTuple):
    """Where objects are not to be."""

    point: Float[np.ndarray, " 3"]
    """world frame [m]"""
    distance: float
    """least of their origins from it [m]"""


def draw_problem(
    scene: Scene,
    trials: int,
    seed: int,
    config: SamplingConfig | None = None,
    away: Away | None = None,
    objects: Sequence[int] | None = None,
) -> GraspProblem:
    """Random poses at rest on the table, as start states are sampled (method §4).

    None is where the robot at home would be in the object. An object's poses, and the seeds of its
    trials, depend on the seed, the robot and itself alone.

    Args:
        scene: Robot and objects.
        trials: Poses of each.
        seed: Of the poses and headings.
        config: The object area, and how many stand as scanned.
        away: From where they keep away.
        objects: Which of the scene's; all by default.

    Raises:
        InputError: They can lie nowhere else.
    """
    config, checker = config or SamplingConfig(), CollisionChecker(scene)
    home = np.asarray(scene.robot.home)
    indices = range(len(scene.objects)) if objects is None else objects

    def poses(index: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
        obj = scene.objects[index]
        rng = np.random.default_rng([seed, int(obj.content_hash[:8], 16)])
        resting = poses_at_rest(obj, config.standing)
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for _ in range(_ROUNDS):
            wanted = trials if away is None else _DRAWS * (trials + 10)
            drawn = sample_object_poses(resting, wanted, config, rng)
            for p, quat in zip(*drawn, strict=True):
                far = away is None or np.linalg.norm(p - away.point) >= away.distance
                if far and checker.reason(home, p, quat, index) is None:
                    found.append((p, quat))
                if len(found) == trials:
                    return np.stack([p for p, _ in found]), np.stack([q for _, q in found])
        if away is not None:
            raise InputError("away", away.distance, "less: the object area ends before [m]")
        raise InputError("object", obj.name, "one with room beside the robot at home")

    def seeds(index: int) -> Int[np.ndarray, " n"]:
        own = int(scene.objects[index].content_hash[:8], 16)
        return np.random.default_rng([seed, own, 1]).integers(2**31, size=trials)

    places = [poses(index) for index in indices]
    worlds = trials * len(places)
    angles = np.random.default_rng([seed, 2]).uniform(0.0, 2.0 * np.pi, (2, worlds))
    return GraspProblem(
        object_index=np.repeat(np.asarray(indices), trials),
        p_wo=np.concatenate([p for p, _ in places]).astype(np.float32),
        quat=np.concatenate([quat for _, quat in places]).astype(np.float32),
        headings=angles.T,
        seed=np.concatenate([seeds(index) for index in indices]),
    )
