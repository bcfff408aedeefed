"""Pre-grasps of one object: poses, candidates, inverse kinematics, collisions (method §4)."""

from __future__ import annotations

import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.mesh import vertex_areas
from mjx_grasp.grasp.candidates import Candidates, vertex_candidates
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.targets import WAYS, TargetOptions, admissible, target_options
from mjx_grasp.handoff.attempts import Attempts, Pairs, attempt_all
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.report import OUTCOMES, ObjectReport
from mjx_grasp.handoff.rows import Row, as_set
from mjx_grasp.handoff.sampling import (
    draw_candidates,
    poses_at_rest,
    rotation_matrix,
    sample_object_poses,
)
from mjx_grasp.heatmap.compute import heatmap_of, heatmap_surface
from mjx_grasp.objects.clearance import collision_field
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.library import build_library
from mjx_grasp.reaching.still import StillObject
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.scene import build_scene


@dataclass
class _Accepted:
    """A state that passed, and what orders the choice among many."""

    pose: int
    candidate: int
    row: Row


class _Task(NamedTuple):
    """What does not change from round to round."""

    obj: ObjectModel
    what: StillObject
    options: TargetOptions
    area: Float[np.ndarray, " c"]
    """of the surface around each candidate [m²]"""
    suits: Bool[np.ndarray, " c"]
    """which candidates have a sufficient score"""
    checker: CollisionChecker


class HandoffGenerator:
    """Makes pre-grasps of objects for one robot.

    The library of starts and the compiled solver are shared by all objects; what an object gets
    depends on the configuration's seed and its own name only.
    """

    def __init__(self, robot: RobotSpec, config: HandoffConfig):
        """Builds the start library and compiles nothing yet.

        Args:
            robot: Arm and hand.
            config: Settings.

        Raises:
            InputError: The robot does not reach the object area.
        """
        self._robot, self._config = robot, config
        self._body = robot_body(robot)
        self._library = build_library(
            self._body, config.posture.library, config.sampling.area, config.seed
        )

    def generate(
        self, obj: ObjectModel, progress: Callable[[int], None] = lambda kept: None
    ) -> tuple[HandoffSet, ObjectReport]:
        """Pre-grasps of one object, and the report of what was rejected.

        Args:
            obj: The object.
            progress: Told how many states are there, after every round.
        """
        started = time.perf_counter()
        config, report = self._config, ObjectReport(obj.name)
        rng = np.random.default_rng([config.seed, zlib.crc32(obj.name.encode())])
        candidates = vertex_candidates(heatmap_of(obj, self._robot.hand, config.heatmap))
        suits = np.asarray(candidates.valid & (candidates.score >= config.sampling.min_score))
        report.eligible_candidates = int(suits.sum())
        chosen: list[_Accepted] = []
        if suits.any():
            options = target_options(candidates, config.targets)
            checker = CollisionChecker(build_scene([obj], self._robot))
            surface = heatmap_surface(obj.mesh, config.heatmap)
            area = vertex_areas(np.asarray(surface.vertices), np.asarray(surface.faces))
            shape = collision_field(obj, config.posture.grid)
            com, weight = jnp.asarray(obj.com, jnp.float32), jnp.float32(obj.weight)
            what = StillObject(shape, candidates, com, weight)
            task = _Task(obj, what, options, area, suits, checker)
            accepted: list[_Accepted] = []
            for _ in range(config.max_rounds):
                accepted += self._round(task, report, rng)
                chosen = self._choose(accepted)
                progress(len(chosen))
                if len(chosen) == config.per_object:
                    break
        rows = [state.row for state in chosen]
        made = as_set(self._body, config.targets, obj, rows, reached=False)
        report.keep(made, time.perf_counter() - started)
        return made, report

    def _round(
        self, task: _Task, report: ObjectReport, rng: np.random.Generator
    ) -> list[_Accepted]:
        """Draws poses and candidates, solves them all, checks what converged."""
        sampling, candidates = self._config.sampling, task.what.candidates
        resting = poses_at_rest(task.obj, sampling.standing)
        pos, quat = sample_object_poses(resting, sampling.poses_per_round, sampling, rng)
        # Rounded to what the file holds, so that exactly the saved state is checked.
        pos, quat = np.asarray(pos, np.float32), np.asarray(quat, np.float32)
        turns = np.array([rotation_matrix(q) for q in quat], np.float32)
        high = np.asarray(_admissible(candidates, task.options, pos, turns, self._config.targets))
        score, thumb = np.asarray(candidates.score), np.asarray(candidates.thumb)
        pairs: list[tuple[int, int]] = []
        for k in range(len(pos)):
            allowed = task.suits & high[k].any(axis=1)
            drawn = draw_candidates(score, task.area, thumb, allowed, sampling, rng)
            report.poses_without_candidate += len(drawn) == 0
            pairs += [(k, c) for c in drawn]
        first_pose = report.poses
        report.poses += len(pos)
        if not pairs:
            return []
        report.sampled += len(pairs)

        # Filled up to one size with repetitions, for one compilation.
        size = sampling.poses_per_round * sampling.candidates_per_pose
        pose, candidate = np.resize(pairs, (size, 2)).T
        ways = jax.tree.map(
            lambda leaf: np.asarray(leaf).reshape(-1, WAYS, *leaf.shape[1:])[candidate],
            task.options,
        )
        posture, targets = self._config.posture, self._config.targets
        tried = Pairs(ways, *map(jnp.asarray, (high[pose, candidate], pos[pose], turns[pose])))
        found = attempt_all(self._body, self._library, posture, targets, task.what, tried)
        found = jax.tree.map(np.asarray, found)
        accepted = []
        for n in range(len(pairs)):
            at = pos[pose[n]], quat[pose[n]]
            one = Attempts(*(leaf[n] for leaf in found))
            start, outcome = self._first_clear(one, partial(_reason, task.checker, *at))
            report.converged += outcome not in ("unreachable", "limits")
            if outcome is not None:
                report.rejected[outcome] += 1
                continue
            report.feasible += 1
            row = {
                "object_pos": at[0],
                "object_quat": at[1],
                "q": found.q[n, start],
                "target_pos": found.position[n, start],
                "target_normal": found.normal[n, start],
                "score": score[candidate[n]],
                "residual": found.error[n, start],
            }
            accepted.append(_Accepted(first_pose + int(pose[n]), int(candidate[n]), row))
        return accepted

    def _first_clear(
        self, found: Attempts, collision: Callable[[np.ndarray], str | None]
    ) -> tuple[int, str | None]:
        """The best start that nothing refuses, or the reason of the one that got farthest."""
        farthest = -1
        for start in np.argsort(np.asarray(found.cost), kind="stable").tolist():
            if not np.isfinite(found.cost[start]):
                continue
            if np.max(found.error[start]) > self._config.posture.tolerance:
                outcome = "limits" if found.at_limit[start] else "unreachable"
            elif not found.agrees[start]:
                outcome = "reach-axis"
            elif found.lift_error[start] > self._config.posture.lift_error:
                outcome = "lift"
            elif found.touch_error[start] > self._config.posture.touch_error:
                outcome = "touch"
            elif not found.holds[start]:
                outcome = "hold"
            else:
                reason = collision(np.asarray(found.q[start]))
                if reason is None:
                    return start, None
                outcome = reason
            farthest = max(farthest, OUTCOMES.index(outcome))
        return -1, OUTCOMES[farthest]

    def _choose(self, accepted: list[_Accepted]) -> list[_Accepted]:
        """As many as wanted: one of every pose before a second of any, few of each candidate."""
        used: Counter = Counter()
        taken: Counter = Counter()
        ordered = []
        for state in accepted:
            ordered.append((taken[state.pose], state.pose, state))
            taken[state.pose] += 1
        chosen = []
        for _, _, state in sorted(ordered, key=lambda item: item[:2]):
            if used[state.candidate] < self._config.max_per_candidate:
                used[state.candidate] += 1
                chosen.append(state)
        return chosen[: self._config.per_object]


@partial(jax.jit, static_argnames="config")
def _admissible(
    candidates: Candidates,
    options: TargetOptions,
    p_wo: Float[Array, "n 3"],
    R_wo: Float[Array, "n 3 3"],
    config: TargetConfig,
) -> Bool[Array, "n c v"]:
    """Which ways of each candidate may be used with the object at each of its poses."""

    def at(pose: tuple[Array, Array]) -> Array:
        return admissible(candidates, options, *pose, config).reshape(-1, WAYS)

    return jax.lax.map(at, (p_wo, R_wo))


def _reason(
    checker: CollisionChecker,
    pos: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
    q: Float[np.ndarray, " joints"],
) -> str | None:
    """Why a configuration is refused with the object at a pose; None if it is not."""
    return checker.reason(q, pos, quat)
