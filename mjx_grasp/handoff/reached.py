"""Reached handoffs of one object: home, selection, reaching, gate, collisions (method §3, §4).

Objects lie as for inverse kinematics, one reach for each pose: the selection takes what it would
take on the robot. So few candidates may have most of the states, and no draw evens that out.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.handoff.config import HandoffConfig, PostureConfig
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.report import ObjectReport
from mjx_grasp.handoff.rows import Row, as_set
from mjx_grasp.handoff.sampling import poses_at_rest, rotation_matrix, sample_object_poses
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.assemble import whole_grasps
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.posture.body import Body, robot_body
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.posture.touch import touching
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.holding import can_hold
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import GATES, ReachPreset, with_gate
from mjx_grasp.reaching.state import ReachOutcome
from mjx_grasp.reaching.still import (
    WORLDS,
    Arrival,
    Placed,
    StillObject,
    in_parts,
    plans_still,
    reach_still,
)
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import joint_columns
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.scene import build_scene

_SPARE = 1.25
"""More poses are drawn than states are missing: some reaches fail."""


def reach_settings(config: HandoffConfig) -> ReachPreset:
    """The controller of whole grasps with the gate, targets and least score that are asked for."""
    settings = whole_grasps()
    gate = GATES[config.gate]
    if config.gate_midpoint is not None:
        gate = replace(gate, midpoint=config.gate_midpoint)
    least = max(
        config.targets.min_goal_height, settings.selection.targets.min_goal_height
    )  # the controller's own: tips go to their goals past the table
    selection = replace(
        settings.selection,
        min_score=config.sampling.min_score,
        targets=replace(config.targets, min_goal_height=least),
    )
    assert settings.plan is not None
    plan = replace(
        settings.plan,
        library=config.posture.library,
        area=config.sampling.area,
        must_hold=config.posture.must_hold,
        seed=config.seed,
    )
    return with_gate(replace(settings, selection=selection, plan=plan), gate)


class _Task(NamedTuple):
    """What does not change from round to round."""

    obj: ObjectModel
    what: StillObject
    checker: CollisionChecker


class ReachedGenerator:
    """Makes reached handoffs of objects for one robot.

    All objects share the library of starts and the compiled controller; what an object gets depends
    on the configuration's seed and its own name only.
    """

    def __init__(
        self, robot: RobotSpec, config: HandoffConfig, settings: ReachPreset | None = None
    ):
        """Builds the start library and compiles nothing yet.

        Args:
            robot: Arm and hand.
            config: Settings; `per_object` is how many reached states are wanted.
            settings: What reaches, with plans; by default that of `reach_settings`.

        Raises:
            InputError: The robot does not reach the object area, or has idle fingers that are to
                stay at zero, but are bent at home; or the settings have no plans.
        """
        self._robot, self._config = robot, config
        settings = settings or reach_settings(config)
        if settings.plan is None:
            raise InputError("settings", "a preset without plans", "one that plans")
        moves = robot.without_idle_fingers() if config.fix_idle_fingers else robot
        self._body, self._columns = robot_body(robot), joint_columns(moves)
        self._reacher = Reacher(robot_body(moves), settings.reach, settings.selection)
        self._planner = Planner(self._reacher, settings.plan)
        self._library = start_library(self._reacher.body, settings.plan)
        self._worlds = min(WORLDS, config.sampling.poses_per_round)

    def generate(
        self, obj: ObjectModel, progress: Callable[[int], None] = lambda kept: None
    ) -> tuple[HandoffSet, ObjectReport]:
        """Reached handoffs of one object, and the report of what was refused.

        Args:
            obj: The object.
            progress: Told how many states are there, after every round.
        """
        started = time.perf_counter()
        config, report = self._config, ObjectReport(obj.name, "reached")
        name = zlib.crc32(obj.name.encode())
        rng = np.random.default_rng([config.seed, name, 1])  # other poses than those of `ik`
        key = jax.random.fold_in(jax.random.key(config.seed), name)
        heatmap = heatmap_of(obj, self._robot.hand, config.heatmap)
        known = known_object(obj, self._robot, heatmap)
        scores = known.candidates.score[known.candidates.valid]
        report.eligible_candidates = int(jnp.sum(scores >= config.sampling.min_score))
        rows: list[Row] = []
        if jnp.any(scores > 0):  # plans go on to lesser ones where none is good enough
            checker = CollisionChecker(build_scene([obj], self._robot))
            what = StillObject(known.shape, known.candidates, known.com, known.weight)
            task = _Task(obj, what, checker)
            for _ in range(config.max_rounds):
                missing = config.per_object - len(rows)
                rows += self._round(task, report, rng, key, missing)[:missing]
                progress(len(rows))
                if len(rows) == config.per_object:
                    break
        made = as_set(self._body, self._reacher.selection.targets, obj, rows, reached=True)
        report.keep(made, time.perf_counter() - started)
        return made, report

    def _round(
        self, task: _Task, report: ObjectReport, rng: np.random.Generator, key: Array, missing: int
    ) -> list[Row]:
        """Draws poses, reaches for the object at each, checks where the hand came to."""
        sampling = self._config.sampling
        # A full round, or as many as the worlds can do together that are likely to be enough.
        full = self._worlds * math.ceil(_SPARE * missing / self._worlds)
        count = min(full, sampling.poses_per_round)
        resting = poses_at_rest(task.obj, sampling.standing)
        pos, quat = sample_object_poses(resting, count, sampling, rng)
        # Rounded to what the file holds, so that exactly the saved state is checked.
        pos, quat = np.asarray(pos, np.float32), np.asarray(quat, np.float32)
        turns = np.array([rotation_matrix(q) for q in quat], np.float32)
        numbers = jnp.arange(report.poses, report.poses + count)
        keys = jax.vmap(partial(jax.random.fold_in, key))(numbers)
        plans = plans_still(self._planner, self._library, task.what, pos, turns, keys, self._worlds)
        placed = Placed(jnp.asarray(pos), jnp.asarray(turns), plans)
        found = reach_still(self._reacher, task.what, placed, self._worlds)
        report.poses += count
        report.sampled += count
        rows: list[Row] = []
        q = np.zeros((count, len(self._robot.joints)), np.float32)
        q[:, self._columns] = found.q
        for n, outcome in enumerate(self._outcomes(task, placed, found, q, pos, quat)):
            report.poses_without_candidate += outcome == "no-candidate"
            report.converged += outcome not in ("no-candidate", "not-reached")
            if outcome is not None:
                report.rejected[outcome] += 1
                continue
            report.feasible += 1
            report.reach_seconds.append(float(found.clock[n]))
            rows.append(
                {
                    "object_pos": pos[n],
                    "object_quat": quat[n],
                    "q": q[n],
                    "target_pos": found.position[n],
                    "target_normal": found.normal[n],
                    "score": found.score[n],
                    "residual": found.error[n],
                }
            )
        return rows

    def _outcomes(
        self,
        task: _Task,
        placed: Placed,
        found: Arrival,
        q: Float[np.ndarray, "n joints"],
        pos: Float[np.ndarray, "n 3"],
        quat: Float[np.ndarray, "n 4"],
    ) -> Iterator[str | None]:
        """Why each reach is refused; None if it is not."""
        posture = self._config.posture
        body, worlds = self._reacher.body, self._worlds
        ahead = _ahead(body, posture, task.what, placed, found, worlds)
        for n, outcome in enumerate(found.outcome):
            if outcome == ReachOutcome.NO_CANDIDATE:
                yield "no-candidate"
            elif outcome != ReachOutcome.HANDOFF:
                yield "not-reached"
            elif ahead.lift[n] > posture.lift_error:
                yield "lift"
            elif ahead.touch[n] > posture.touch_error:
                yield "touch"
            elif not ahead.holds[n]:
                yield "hold"
            else:
                yield task.checker.reason(q[n], pos[n], quat[n])


class _Ahead(NamedTuple):
    """What would come of states, worlds in front."""

    lift: Float[Array, " n"]
    """from where a lift straight up should bring the palm to where it does [m]"""
    touch: Float[Array, " n"]
    """that the worst finger stays away from its contact when it closes [m]"""
    holds: Bool[Array, " n"]
    """whether the closed hand can hold the object"""


def _ahead(
    body: Body,
    config: PostureConfig,
    what: StillObject,
    placed: Placed,
    found: Arrival,
    worlds: int,
) -> _Ahead:
    """What would come of where reaches ended."""
    ends = placed.p_wo, placed.R_wo, found.q, found.position, found.normal
    return in_parts(
        lambda rows: _come_of(body, config, what, *(leaf[rows] for leaf in ends)),
        len(found.q),
        worlds,
    )


@partial(jax.jit, static_argnames=("body", "config"))
@partial(jax.vmap, in_axes=(None, None, None, 0, 0, 0, 0, 0))
def _come_of(
    body: Body,
    config: PostureConfig,
    what: StillObject,
    p_wo: Float[Array, " 3"],
    R_wo: Float[Array, "3 3"],
    q: Float[Array, " joints"],
    contacts: Float[Array, "3 3"],
    normals: Float[Array, "3 3"],
) -> _Ahead:
    around = Surroundings.still(what.shape, p_wo, R_wo, what.com, what.weight)
    closed = touching(body, q, contacts)
    return _Ahead(
        lift=scripted_lift(body, q, config.lift_height).error,
        touch=jnp.max(closed.error),
        holds=can_hold(body, config.must_hold, closed.q, contacts, normals, around),
    )
