"""From the states that were accepted to a set of one object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.targets import standoffs
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.posture.body import FINGERS, Body
from mjx_grasp.reaching.fields import midpoint

Row = Mapping[str, np.ndarray | Array]
"""One state: pose of the object, q, targets, normals, score and tip errors by their names."""


def as_set(
    body: Body, targets: TargetConfig, obj: ObjectModel, rows: Sequence[Row], reached: bool
) -> HandoffSet:
    """The states of an object as a set.

    Args:
        body: The robot.
        targets: The standoffs.
        obj: The object.
        rows: Its states.
        reached: Whether they are the ends of reaches.
    """
    shapes = {
        "object_pos": (3,),
        "object_quat": (4,),
        "q": (len(body.robot.joints),),
        "target_pos": (3, 3),
        "target_normal": (3, 3),
        "score": (),
        "residual": (3,),
    }
    arrays = {
        name: np.array([row[name] for row in rows], np.float32).reshape(-1, *tail)
        for name, tail in shapes.items()
    }
    placed = zip(arrays["q"], arrays["target_pos"], arrays["target_normal"], strict=True)
    errors = [_midpoint_error(body, targets, *map(jnp.asarray, state)) for state in placed]
    return HandoffSet(
        object_index=np.zeros(len(rows), np.int32),
        **arrays,
        midpoint=np.array(errors, np.float32),
        reached=np.full(len(rows), reached),
        object_names=(obj.name,),
        object_content_hash=(obj.content_hash,),
        robot=body.robot.identity,
    )


@partial(jax.jit, static_argnames=("body", "targets"))
def _midpoint_error(
    body: Body,
    targets: TargetConfig,
    q: Float[Array, " joints"],
    position: Float[Array, "3 3"],
    normal: Float[Array, "3 3"],
) -> Float[Array, ""]:
    """Of the midpoint of the tips, from that of their standoff targets [m]."""
    with jax.default_matmul_precision("highest"):
        tips = body.kinematics.motion(q).pos[:FINGERS]
        return norm(midpoint(tips) - midpoint(standoffs(position, normal, targets)))
