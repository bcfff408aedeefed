"""What each trial of whole grasps begins with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.evaluation.grasps.circumstances import (
    Circumstances,
    circumstances,
)
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.body import FINGERS
from mjx_grasp.reaching.fields import midpoint
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import at_rest
from mjx_grasp.sim.physics import Physics, Truth, WorldParams, make_params
from mjx_grasp.sim.scene import Scene


class GraspProblem(NamedTuple):
    """What is grasped in each trial; world frame."""

    object_index: Int[np.ndarray, " w"]
    """into the scene's objects"""
    p_wo: Float[np.ndarray, "w 3"]
    """object origin at the start [m]"""
    quat: Float[np.ndarray, "w 4"]
    """its rotation, w-x-y-z"""
    headings: Float[np.ndarray, "w 2"]
    """from x about z, of what carries it and of what pushes it, if anything does [rad]"""
    seed: Int[np.ndarray, " w"]
    """of the trial's plans and of the tracker's noise in it"""


class Trial(NamedTuple):
    """What each trial begins with and keeps, beside what is known of its object."""

    given: Circumstances
    params: WorldParams
    qpos: Float[Array, "w nq"]
    measured: Measured
    """at rest"""
    truth: Truth
    key: Array
    """two of each trial: of its plans, and of the tracker's noise"""


def stacked(known: Sequence[Known]) -> Known:
    """What is known of several objects, in one piece."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *known)


def home_tips(grasper: Grasper) -> Float[np.ndarray, " 3"]:
    """Midpoint of the fingertips at home, world frame [m]."""
    body = grasper.reacher.body
    return np.asarray(midpoint(body.kinematics.motion(jnp.asarray(body.home)).pos[:FINGERS]))


def trials_of(
    grasper: Grasper,
    physics: Physics,
    problem: GraspProblem,
    scenarios: Sequence[Scenario],
) -> Trial:
    """All trials as they begin; arguments as of `grasp_all`."""
    scene, count = physics.scene, len(problem.object_index)
    at, given = scene.addresses, _given(grasper, scene, problem, scenarios)
    qpos = np.zeros((count, scene.model.nq), np.float32)
    qpos[:, at.robot_qpos] = np.asarray(grasper.reacher.body.home, np.float32)
    qpos[:, at.object_qpos] = np.concatenate([problem.p_wo, problem.quat], axis=1)
    measured, truth = at_rest(scene, qpos, physics.substeps)
    friction, index = scene.config.friction[0], jnp.asarray(problem.object_index)
    return Trial(
        given=given,
        params=make_params(index, friction, given.mass_scale),
        qpos=jnp.asarray(qpos),
        measured=measured,
        truth=truth,
        key=jax.vmap(jax.random.split)(jax.vmap(jax.random.key)(jnp.asarray(problem.seed))),
    )


def _given(
    grasper: Grasper, scene: Scene, problem: GraspProblem, scenarios: Sequence[Scenario]
) -> Circumstances:
    """What happens in each trial."""
    tips, friction = home_tips(grasper), scene.config.friction[0]
    mass = np.array([obj.mass for obj in scene.objects])[problem.object_index]
    of_each = [np.split(x, len(scenarios)) for x in (problem.p_wo, problem.headings, mass)]
    parts = [
        circumstances(scenario, p_wo, headings, mass, friction, tips, grasper.dt)
        for scenario, p_wo, headings, mass in zip(scenarios, *of_each, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
