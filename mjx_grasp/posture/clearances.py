"""Everything that must stay apart, and what is asked for (method §3, 'half-spaces')."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.posture.body import Body
from mjx_grasp.posture.config import ClearanceConfig
from mjx_grasp.posture.surroundings import (
    Proximity,
    Surroundings,
    arm_proximity,
    finger_proximity,
    object_proximity,
    obstacle_proximity,
    stacked,
    table_proximity,
)
from mjx_grasp.robot.kinematics import Motion


def proximities(
    body: Body, motion: Motion, around: Surroundings, clearances: ClearanceConfig
) -> tuple[dict[str, Proximity], Float[Array, " m"]]:
    """Distances to all that must stay apart, by kind, and what is asked for of each, [m]."""
    parts = [body.hand_capsules, body.palm_points, body.arm_capsules]
    near = {"object": object_proximity(body, parts, motion, around)}
    safe = [clearances.object] * len(near["object"].distance)
    if around.obstacles.shape[0]:
        near["obstacles"] = stacked([obstacle_proximity(body, s, motion, around) for s in parts])
        safe += [clearances.obstacles] * len(near["obstacles"].distance)
    whole_palm = np.arange(len(body.palm_points.frame))[None]
    groups = (body.fingers, whole_palm, body.arm_capsules.groups)
    near["table"] = stacked(
        [table_proximity(body, s, g, motion) for s, g in zip(parts, groups, strict=True)]
    )
    safe += table_clearances(body, clearances)
    near["fingers"] = finger_proximity(body, motion)
    safe += [clearances.fingers] * len(near["fingers"].distance)
    near["arm"] = arm_proximity(body, motion)
    safe += [clearances.arm] * len(near["arm"].distance)
    return near, jnp.asarray(safe)


def table_clearances(body: Body, clearances: ClearanceConfig) -> list[float]:
    """What the rows of the table ask for, [m]."""
    hand, arm = len(body.fingers) + 1, len(body.arm_capsules.groups)
    return [clearances.hand_table] * hand + [clearances.arm_table] * arm


def row_count(body: Body, obstacles: int) -> int:
    """How many distances there are.

    Args:
        body: The robot.
        obstacles: Number of obstacles.
    """
    parts = [body.hand_capsules, body.palm_points, body.arm_capsules]
    around_object = sum(s.rows for s in parts)
    table = len(body.fingers) + 1 + len(body.arm_capsules.groups)
    return around_object * (2 if obstacles else 1) + table + len(body.pairs) + len(body.arm_pairs)
