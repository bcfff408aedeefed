"""Closed-loop rollouts of the `Grasper` in physics: all trials, as many at once as asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int

from mjx_grasp.evaluation.grasps.hits import hits
from mjx_grasp.evaluation.grasps.kept import GraspEnd, Kept, Trace
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.evaluation.grasps.trials import GraspProblem, stacked, trials_of
from mjx_grasp.evaluation.grasps.worlds import UnderWay
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.library import Library
from mjx_grasp.sim.physics import Physics


def grasp_all(
    grasper: Grasper,
    library: Library | None,
    physics: Physics,
    known: Sequence[Known],
    problem: GraspProblem,
    scenarios: Sequence[Scenario] = (Scenario(),),
    worlds: int | None = None,
    which: Int[np.ndarray, " w"] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[GraspEnd, Trace]:
    """Grasps from home, until every trial has ended; none goes on because another one does.

    A world whose trial has ended takes up the next one. Trials know nothing of each other: what
    is drawn for one depends neither on the others nor on how many run at once, and what comes of
    it only as far as rounding does.

    Args:
        grasper: The controller.
        library: Where its planner starts; None for one without a planner.
        physics: Of the scene with all objects of the problem.
        known: Of each of the scene's objects, in its order.
        problem: Objects and where they are.
        scenarios: What happens meanwhile; by default nothing. Several have equal shares of the
            trials, one after the other, and as many obstacles each.
        worlds: Trials under way at once, as many as the physics has worlds; by default all.
        which: What of ``known`` is of each trial; by default that of its object.
        progress: Told which share of the work is done, of the longest that it could be.
    """
    count, dt = len(problem.object_index), grasper.dt
    worlds = min(worlds or count, count)
    trials = trials_of(grasper, physics, problem, scenarios)
    which = problem.object_index if which is None else which
    under_way = UnderWay(grasper, library, physics, trials, stacked(known), which)
    longest = grasper.config.timeout_s + max(each.hold_s for each in scenarios) + 2.0
    kept = Kept(count, round(longest / dt))
    at = np.arange(worlds)
    """the trial of each world; the number of all where none is left"""
    running = under_way.begun(at)
    following = worlds
    while (at < count).any():
        running, ticks, over = under_way.segment(running)
        kept.add(at, ticks)
        over |= kept.ticks[np.minimum(at, count - 1)] >= kept.most
        ended = np.flatnonzero(over & (at < count))
        if len(ended):
            kept.end(at[ended], under_way.ends(running, ended))
            at[ended] = count
            new = ended[: count - following]
            at[new] = following + np.arange(len(new))
            following += len(new)
            running = under_way.taken_up(running, new, at[new])
        due = np.flatnonzero(np.asarray(running.carry.due) & (at < count))
        if len(due):
            running = under_way.replanned(running, due)
        progress(kept.share())
    (grasp, judged, plans, *incidents), trace = kept.ended, kept.trace()
    obstacles, q = np.asarray(trials.given.obstacles), physics.scene.addresses.robot_qpos
    hit = hits(physics.scene.robot, np.asarray(trace.qpos), q, kept.ticks, obstacles)
    return GraspEnd(grasp, judged, plans - 1, obstacles, hit, *incidents), trace
