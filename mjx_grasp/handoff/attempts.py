"""Postures for many pairs of an object pose and a candidate: all its targets, from many starts."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.targets import TargetOptions, closest_axis, standoffs
from mjx_grasp.handoff.config import PostureConfig
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.ik import TipGoals, solve_ik
from mjx_grasp.posture.library import Library, Options, choose_starts
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.posture.touch import touching
from mjx_grasp.reaching.holding import can_hold
from mjx_grasp.reaching.still import StillObject

# Pairs worked on at once: few enough for a processor's cache, many enough for an accelerator.
_TILE = 32


class Pairs(NamedTuple):
    """Candidates of an object, each with the object at a pose of its own."""

    ways: TargetOptions
    """``[n, ways, …]`` to assign the tips"""
    admissible: Bool[Array, "n ways"]
    """which of them may be used"""
    p_wo: Float[Array, "n 3"]
    """object origin in world [m]"""
    R_wo: Float[Array, "n 3 3"]
    """object rotation"""


class Attempts(NamedTuple):
    """What came of the starts of each pair."""

    q: Float[Array, "n s joints"]
    """[rad]"""
    error: Float[Array, "n s 3"]
    """tip frames to their standoff targets [m]"""
    at_limit: Bool[Array, "n s"]
    """whether a joint is at its limit"""
    cost: Float[Array, "n s"]
    """objective of the solver, +inf for a way that may not be used [m²]"""
    agrees: Bool[Array, "n s"]
    """whether the selection would take the same reach axis with this palm (method §2)"""
    lift_error: Float[Array, "n s"]
    """from where a lift straight up should bring the palm to where it does [m]"""
    touch_error: Float[Array, "n s"]
    """that the worst finger stays away from its contact when it closes [m]"""
    holds: Bool[Array, "n s"]
    """whether the closed hand can hold the object at its contacts"""
    position: Float[Array, "n s 3 3"]
    """targets of thumb, first and second wrap, world [m]"""
    normal: Float[Array, "n s 3 3"]
    """outward unit normals there"""


@partial(jax.jit, static_argnames=("body", "config", "targets"))
def attempt_all(
    body: Body,
    library: Library,
    config: PostureConfig,
    targets: TargetConfig,
    what: StillObject,
    pairs: Pairs,
) -> Attempts:
    """Looks for postures of all pairs.

    Args:
        body: The robot.
        library: Where the solver may start.
        config: Starts, solver, clearances.
        targets: The standoffs.
        what: The object; its candidates are those of the pairs.
        pairs: What is tried.
    """
    home, key = jnp.asarray(body.home), jax.random.key(0)

    def one(pair: Pairs) -> Attempts:
        position = pair.p_wo + pair.ways.position @ pair.R_wo.T
        normal = pair.ways.normal @ pair.R_wo.T
        goals = TipGoals(standoffs(position, normal, targets), -normal)
        around = Surroundings.still(what.shape, pair.p_wo, pair.R_wo, what.com, what.weight)
        options = Options(goals, pair.admissible)
        starts = choose_starts(body, library, config.starts, options, around, home, key)

        def attempt(way: Int[Array, ""], start: Float[Array, " joints"]) -> Attempts:
            wanted = TipGoals(goals.tips[way], goals.pads[way])
            found = solve_ik(body, config.ik, config.clearances, wanted, around, start, home)
            approach = body.palm.forward(found.q)[1][0] @ body.approach_axis
            closed = touching(body, found.q, position[way])
            # What the selection would take does not depend on heights.
            taken = closest_axis(jnp.abs(approach @ pair.R_wo), pair.ways.usable[::2])
            return Attempts(
                q=found.q,
                error=found.error,
                at_limit=found.at_limit,
                cost=jnp.where(pair.admissible[way], found.cost, jnp.inf),
                agrees=pair.ways.axis[way] == taken,
                lift_error=scripted_lift(body, found.q, config.lift_height).error,
                touch_error=jnp.max(closed.error),
                holds=can_hold(
                    body, config.must_hold, closed.q, position[way], normal[way], around
                ),
                position=position[way],
                normal=normal[way],
            )

        return jax.vmap(attempt)(starts.option, starts.q)

    with jax.default_matmul_precision("highest"):
        return jax.lax.map(one, pairs, batch_size=_TILE)
