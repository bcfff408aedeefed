"""Configurations about to grasp something, and which of them a search starts from."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.geometry.vectors import dot, norm, unit
from mjx_grasp.posture.body import FINGERS, PALM, Body
from mjx_grasp.posture.config import StartConfig
from mjx_grasp.posture.draw import draw_postures
from mjx_grasp.posture.ik import TipGoals
from mjx_grasp.posture.surroundings import Surroundings, placed, to_object
from mjx_grasp.sim.scene import ObjectArea


class Library(NamedTuple):
    """Configurations with the hand about to grasp something over the table."""

    q: Float[Array, "l joints"]
    """[rad]"""
    tips: Float[Array, "l 3 3"]
    """tip frames in world [m]"""
    pads: Float[Array, "l 3 3"]
    """pad normals in world"""


class Options(NamedTuple):
    """Ways to place the fingertips, of which one is enough."""

    goals: TipGoals
    """``[v, …]``"""
    admissible: Bool[Array, " v"]
    """which of them may be used"""


class Starts(NamedTuple):
    """Where searches start, the most promising first."""

    option: Int[Array, " s"]
    """what each is for"""
    q: Float[Array, "s joints"]
    """[rad]"""


def build_library(body: Body, count: int, area: ObjectArea, seed: int) -> Library:
    """Draws the library of a robot; takes some seconds.

    Args:
        body: The robot.
        count: Configurations wanted.
        area: Where objects lie.
        seed: Of the draw.

    Raises:
        InputError: The robot does not reach the object area.
    """
    q = jnp.asarray(draw_postures(body, count, area, seed))

    @jax.jit
    @jax.vmap
    def tips_and_pads(q: Float[Array, " joints"]) -> tuple[Array, Array]:
        motion = body.kinematics.motion(q)
        return motion.pos[:FINGERS], motion.mat[FINGERS:PALM, :, 0]

    return Library(q, *tips_and_pads(q))


def choose_starts(
    body: Body,
    library: Library,
    config: StartConfig,
    options: Options,
    around: Surroundings,
    q: Float[Array, " joints"],
    key: Array,
) -> Starts:
    """The most promising entries of a library, each for the option that it is nearest to.

    By ``|tips − goals|² + (w_d |pads − goals|)² + (w_t · time)² + w_o² Σ overlap²`` with the time
    in which the joints get there, and the overlap of the hand, moved as a rigid body until its
    tips fit the goals, with object and table.

    Args:
        body: The robot.
        library: Of this robot.
        config: Numbers and weights.
        options: Of which any will do.
        around: Object and obstacles.
        q: Present configuration, [rad].
        key: Chooses among the entries around the object.
    """
    near = _around_object(library, config, around, key)

    def features(goals: TipGoals) -> Float[Array, "n 18"]:
        parts = goals.tips - around.p_wo, config.direction_scale * goals.pads
        return jnp.concatenate([part.reshape(-1, 9) for part in parts], axis=1)

    have = features(TipGoals(library.tips[near], library.pads[near]))
    want = features(options.goals)
    squares = jnp.where(options.admissible, jnp.sum(want**2, axis=1), jnp.inf)

    def gap(have: Float[Array, "n 18"]) -> Float[Array, "n v"]:
        return squares - 2.0 * have @ want.T

    # The least alone is quick to find; which option has it is asked for the few that are used.
    least = jnp.min(gap(have), axis=1) + jnp.sum(have**2, axis=1)
    if config.time_scale > 0:
        time = jnp.max(jnp.abs(library.q[near] - q) / body.velocity_limit, axis=1)
        least = least + (config.time_scale * time) ** 2
    overlaps = config.overlap_weight > 0
    few = min(config.ranked, len(near)) if overlaps else config.count
    nearest, best = jax.lax.top_k(-least, few)
    near, option = near[best], jnp.argmin(gap(have[best]), axis=1)
    if overlaps:

        def overlap(entry: Int[Array, ""], option: Int[Array, ""]) -> Float[Array, ""]:
            return _overlap(body, library.q[entry], options.goals.tips[option], around)

        least = config.overlap_weight**2 * jax.vmap(overlap)(near, option) - nearest
        _, best = jax.lax.top_k(-least, config.count)
        near, option = near[best], option[best]
    return Starts(option, library.q[near])


def _around_object(
    library: Library, config: StartConfig, around: Surroundings, key: Array
) -> Int[Array, " n"]:
    """Entries whose tips are around the object."""
    if config.near >= len(library.q):
        return jnp.arange(len(library.q))
    middle = 0.5 * library.tips[:, 0] + 0.25 * (library.tips[:, 1] + library.tips[:, 2])
    distance = norm(middle - around.p_wo)
    if config.chance > 0:
        distance = distance + config.chance * jax.random.uniform(key, distance.shape)
    return jax.lax.top_k(-distance, config.near)[1]


def _overlap(
    body: Body, q: Float[Array, " joints"], goals: Float[Array, "3 3"], around: Surroundings
) -> Float[Array, ""]:
    """Squares of how deep spheres of the hand are in object and table, summed, [m²]."""
    motion = body.kinematics.motion(q)
    centres, _ = placed(body.hand_spheres, motion)
    origin, frame = _tip_frame(motion.pos[:FINGERS])
    goal_origin, goal_frame = _tip_frame(goals)
    moved = goal_origin + ((centres - origin) @ frame) @ goal_frame.T
    to_shape = signed_distance(around.shape, to_object(around, moved))
    distance = jnp.minimum(to_shape, moved[:, 2])
    return jnp.sum(jnp.maximum(body.hand_spheres.radius - distance, 0.0) ** 2)


def _tip_frame(tips: Float[Array, "3 3"]) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """A frame on three tips: from the thumb to between the wraps, and along the wraps."""
    middle = 0.5 * (tips[1] + tips[2])
    x = unit(middle - tips[0])
    along = tips[1] - tips[2]
    y = unit(along - dot(along, x) * x)
    return 0.5 * (tips[0] + middle), jnp.stack([x, y, jnp.cross(x, y)], axis=-1)
