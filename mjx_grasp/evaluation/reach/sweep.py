"""Many reaches at once by kinematic integration: what the reach sweep measures (method §3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.evaluation.reach.record import ReachRecord, empty_record, recorded
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import Candidates, cylinder_candidates
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import Library, Planner, Search
from mjx_grasp.reaching.state import Plans, ReachOutcome, ReachState

_SEGMENT = 100


class Problem(NamedTuple):
    """One cylinder to reach for; world frame."""

    shape: Cylinder
    """the cylinder"""
    p_wo: Float[Array, " 3"]
    """its centre [m]"""
    R_wo: Float[Array, "3 3"]
    """its rotation"""
    plans: Plans | None
    """ways to reach it, or None"""


_Reached = tuple[ReachState, Float[Array, " joints"], ReachRecord]
"""A reach under way: state, configuration [rad], record."""


def candidates_of(reacher: Reacher, shape: Cylinder) -> Candidates:
    """Candidates on a cylinder for a robot's hand."""
    return cylinder_candidates(shape.radius, shape.half_length, reacher.body.robot.hand.span)


def plan_all(
    planner: Planner,
    library: Library,
    poses: CylinderPoses,
    chunk: int,
    progress: Callable[[int], None] = lambda poses: None,
    keys: Array | None = None,
) -> Search:
    """Plans for every pose from home, in chunks of one compiled size.

    Args:
        planner: Of the controller.
        library: From :func:`start_library`.
        poses: The cylinders.
        chunk: Poses at a time.
        progress: Told of every chunk how many it has.
        keys: Of each pose; by default those of the first ones from the planner's seed.
    """
    count = len(poses.radius)
    if keys is None:
        keys = plan_keys(planner, count)
    found = []
    for first in range(0, count, chunk):
        rows = _rows(first, chunk, count)
        shape = Cylinder(poses.radius[rows], poses.half_length[rows])
        part = _plans(planner, library, shape, poses.p_wo[rows], poses.R_wo[rows], keys[rows])
        kept = min(chunk, count - first)
        found.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], part))
        progress(kept)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def plan_keys(planner: Planner, count: int) -> Array:
    """Of every pose, from the planner's seed."""
    return jax.random.split(jax.random.key(planner.config.seed), count)


@partial(jax.jit, static_argnames="planner")
def _plans(
    planner: Planner,
    library: Library,
    shape: Cylinder,
    p_wo: Float[Array, "n 3"],
    R_wo: Float[Array, "n 3 3"],
    keys: Array,
) -> Search:
    home = jnp.asarray(planner.reacher.body.home)

    def one(
        shape: Cylinder, p_wo: Float[Array, " 3"], R_wo: Float[Array, "3 3"], key: Array
    ) -> Search:
        around = Surroundings.still(shape, p_wo, R_wo)
        return planner.search(library, candidates_of(planner.reacher, shape), around, home, key)

    return jax.vmap(one)(shape, p_wo, R_wo, keys)


def _rows(first: int, chunk: int, count: int) -> np.ndarray:
    """Indices of a chunk; the last one is filled up by repetition, for one compilation."""
    return np.minimum(np.arange(first, first + chunk), count - 1)


def sweep(
    reacher: Reacher,
    poses: CylinderPoses,
    plans: Plans | None,
    chunk: int,
    progress: Callable[[int], None] = lambda ticks: None,
) -> ReachRecord:
    """Reaches for every pose from home until each has ended; arrays of NumPy.

    Args:
        reacher: The controller; its time-outs end a reach.
        poses: The cylinders.
        plans: For every pose, or None.
        chunk: Poses at a time.
        progress: Told of every pose-tick done.
    """
    count = len(poses.radius)
    longest = int(np.ceil(reacher.config.controller.timeout / reacher.config.controller.dt))
    records = []
    for first in range(0, count, chunk):
        rows = _rows(first, chunk, count)
        problem = Problem(
            Cylinder(poses.radius[rows], poses.half_length[rows]),
            poses.p_wo[rows],
            poses.R_wo[rows],
            jax.tree.map(lambda leaf, rows=rows: leaf[rows], plans),
        )
        state = _begun(reacher, problem)
        kept = min(chunk, count - first)
        for tick in range(0, longest, _SEGMENT):
            state = _gone_on(reacher, problem, state)
            progress(kept * min(_SEGMENT, longest - tick))
            if np.all(np.asarray(state[0].outcome) != ReachOutcome.RUNNING):
                progress(kept * max(longest - tick - _SEGMENT, 0))
                break
        records.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], state[2]))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *records)


@partial(jax.jit, static_argnames="reacher")
def _begun(reacher: Reacher, problem: Problem) -> _Reached:
    return jax.vmap(partial(_begin, reacher))(problem)


@partial(jax.jit, static_argnames="reacher")
def _gone_on(reacher: Reacher, problem: Problem, state: _Reached) -> _Reached:
    return jax.vmap(partial(_segment, reacher))(problem, state)


def _begin(reacher: Reacher, problem: Problem) -> _Reached:
    q = jnp.asarray(reacher.body.home)
    candidates = candidates_of(reacher, problem.shape)
    state = reacher.start(q, candidates, problem.p_wo, problem.R_wo, problem.plans)
    return state, q, empty_record(len(q))


def _segment(reacher: Reacher, problem: Problem, carry: _Reached) -> _Reached:
    candidates = candidates_of(reacher, problem.shape)
    none = jnp.zeros((0, 4))

    def step(carry: _Reached, _: None) -> tuple[_Reached, None]:
        state, q, record = carry
        running = state.outcome == ReachOutcome.RUNNING
        after, tick = reacher.tick(
            state,
            q,
            problem.shape,
            candidates,
            problem.p_wo,
            problem.R_wo,
            none,
            problem.plans,
        )
        q_after = q + reacher.config.controller.dt * tick.velocity
        new = recorded(reacher, record, after, tick, q, q_after)
        record = jax.tree.map(lambda a, b: jnp.where(running, a, b), new, record)
        return (after, q_after, record), None

    return jax.lax.scan(step, carry, length=_SEGMENT)[0]
