"""Many reaches for one object that stands still, by kinematic integration: no physics (method §3).

However many there are, they go through one compiled function of a fixed number of worlds. A world
whose reach has ended takes up the next, so that a slow one keeps no others waiting; as worlds know
nothing of each other, what comes of a reach does not depend on which others there are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry.signed_distance import Shape
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.posture.library import Library
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import Planner
from mjx_grasp.reaching.state import Plans, ReachOutcome, ReachState

Result = TypeVar("Result")

WORLDS = 32
"""Reaches under way at once, and plans looked for in one call, if nothing else is asked for."""
_AT_ONCE = 8
"""Plans worked on at once: few enough for a processor's cache."""
_SEGMENT = 25
"""Ticks between two looks for reaches that have ended."""


class StillObject(NamedTuple):
    """What is reached for; object frame."""

    shape: Shape
    """what to keep away from"""
    candidates: Candidates
    """where it may be grasped"""
    com: Float[Array, " 3"] | None = None
    """centre of mass; the object's origin if None [m]"""
    weight: Float[Array, ""] | None = None
    """unknown if None [N]"""


class Placed(NamedTuple):
    """Where it stands in each world, and the ways to reach it there."""

    p_wo: Float[Array, "n 3"]
    """object origin in world [m]"""
    R_wo: Float[Array, "n 3 3"]
    """object rotation"""
    plans: Plans | None
    """none without a planner"""


class Arrival(NamedTuple):
    """How each reach ended, worlds in front; void until it has."""

    outcome: Int[Array, " n"]
    """a :class:`~mjx_grasp.reaching.state.ReachOutcome`"""
    q: Float[Array, "n joints"]
    """the configuration for which the controller decided so [rad]"""
    error: Float[Array, "n 3"]
    """tip frames to their standoff targets there [m]"""
    midpoint: Float[Array, " n"]
    """of midpoints [m]"""
    position: Float[Array, "n 3 3"]
    """contacts of thumb, first and second wrap, world [m]"""
    normal: Float[Array, "n 3 3"]
    """outward unit normals there"""
    score: Float[Array, " n"]
    """of the candidate"""
    clock: Float[Array, " n"]
    """since the start [s]"""


class _Worlds(NamedTuple):
    """Reaches under way."""

    state: ReachState
    arrival: Arrival


def plans_still(
    planner: Planner,
    library: Library,
    what: StillObject,
    p_wo: Float[np.ndarray, "n 3"],
    R_wo: Float[np.ndarray, "n 3 3"],
    keys: Array,
    worlds: int = WORLDS,
) -> Plans:
    """Plans from home, of one compiled size.

    Args:
        planner: Of the controller.
        library: Where it starts.
        what: The object.
        p_wo: Its origins in world [m].
        R_wo: Its rotations.
        keys: One for each, of what is tried at random.
        worlds: That size.
    """
    return in_parts(
        lambda rows: _search(planner, library, what, p_wo[rows], R_wo[rows], keys[rows]),
        len(p_wo),
        worlds,
    )


def in_parts(
    function: Callable[[Int[np.ndarray, " worlds"]], Result], count: int, worlds: int
) -> Result:
    """What a compiled function gives for many rows, asked for some at a time; arrays of NumPy.

    Args:
        function: Of the numbers of so many rows, the last of them repeated to fill up.
        count: Of rows, one at least.
        worlds: That it is compiled for.
    """
    found = []
    for first in range(0, count, worlds):
        part = function(np.minimum(np.arange(first, first + worlds), count - 1))
        kept = min(worlds, count - first)
        found.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], part))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def reach_still(
    reacher: Reacher,
    what: StillObject,
    placed: Placed,
    worlds: int = WORLDS,
) -> Arrival:
    """Reaches from home until each has ended; arrays of NumPy.

    Args:
        reacher: The controller; its time-out has to be finite, or a reach may never end.
        what: The object.
        placed: Where it stands.
        worlds: Reaches under way at once.
    """
    count = len(placed.p_wo)
    rows = np.minimum(np.arange(worlds), count - 1)
    following, ended = min(worlds, count), np.zeros(count, bool)
    ends: list[Arrival | None] = [None] * count
    running = _begun(reacher, what, _of(placed, rows))
    while not ended.all():
        running = _gone_on(reacher, what, _of(placed, rows), running)
        here = jax.tree.map(np.asarray, running.arrival)
        idle = np.flatnonzero(here.outcome != ReachOutcome.RUNNING)
        for world in idle:
            ends[rows[world]] = Arrival(*(leaf[world] for leaf in here))
        ended[rows[idle]] = True
        idle = idle[: count - following]
        if len(idle):
            rows[idle] = np.arange(following, following + len(idle))
            following += len(idle)
            mask = np.isin(np.arange(worlds), idle)
            running = _taken_up(reacher, what, _of(placed, rows), running, mask)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *ends)


def _of(placed: Placed, rows: Int[np.ndarray, " k"]) -> Placed:
    return jax.tree.map(lambda leaf: leaf[rows], placed)


@partial(jax.jit, static_argnames="planner")
def _search(
    planner: Planner,
    library: Library,
    what: StillObject,
    p_wo: Float[Array, "n 3"],
    R_wo: Float[Array, "n 3 3"],
    keys: Array,
) -> Plans:
    home = jnp.asarray(planner.reacher.body.home)

    def one(place: tuple[Array, Array, Array]) -> Plans:
        p_wo, R_wo, key = place
        around = Surroundings.still(what.shape, p_wo, R_wo, what.com, what.weight)
        return planner.search(library, what.candidates, around, home, key).plans

    return jax.lax.map(one, (p_wo, R_wo, keys), batch_size=_AT_ONCE)


@partial(jax.jit, static_argnames="reacher")
def _begun(reacher: Reacher, what: StillObject, placed: Placed) -> _Worlds:
    home = jnp.asarray(reacher.body.home)

    def one(at: Placed) -> _Worlds:
        state = reacher.start(home, what.candidates, at.p_wo, at.R_wo, at.plans)
        void = jnp.float32(jnp.nan)
        points = jnp.full((3, 3), void)
        return _Worlds(
            state,
            Arrival(state.outcome, home, points[0], void, points, points, void, state.clock),
        )

    return jax.vmap(one)(placed)


@partial(jax.jit, static_argnames="reacher")
def _taken_up(
    reacher: Reacher, what: StillObject, placed: Placed, worlds: _Worlds, mask: Bool[Array, " n"]
) -> _Worlds:
    """The masked worlds begin anew."""
    return jax.tree.map(
        lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b),
        _begun(reacher, what, placed),
        worlds,
    )


@partial(jax.jit, static_argnames="reacher")
def _gone_on(reacher: Reacher, what: StillObject, placed: Placed, worlds: _Worlds) -> _Worlds:
    tick = jax.vmap(partial(_tick, reacher, what))

    def step(worlds: _Worlds, _: None) -> tuple[_Worlds, None]:
        return tick(placed, worlds), None

    return jax.lax.scan(step, worlds, length=_SEGMENT)[0]


def _tick(reacher: Reacher, what: StillObject, at: Placed, before: _Worlds) -> _Worlds:
    """One world's control period; what has ended stays as it is."""
    q, none = before.arrival.q, jnp.zeros((0, 4))
    state, done = reacher.tick(
        before.state, q, what.shape, what.candidates, at.p_wo, at.R_wo, none, at.plans
    )
    runs = state.outcome == ReachOutcome.RUNNING
    targets, report = done.targets, done.report
    arrival = Arrival(
        outcome=state.outcome,
        # Where a reach ends is where its last tick found it, not where its command would lead.
        q=jnp.where(runs, q + reacher.config.controller.dt * done.velocity, q),
        error=report.error,
        midpoint=report.midpoint,
        position=targets.position,
        normal=targets.normal,
        score=what.candidates.score[jnp.maximum(targets.candidate, 0)],
        clock=state.clock,
    )
    running = before.state.outcome == ReachOutcome.RUNNING
    return jax.tree.map(lambda a, b: jnp.where(running, a, b), _Worlds(state, arrival), before)
