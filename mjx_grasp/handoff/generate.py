"""Pre-grasps of one object: poses, candidates, inverse kinematics, collisions (method §4)."""

from __future__ import annotations

import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.grasp.candidates import Candidates, vertex_candidates
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.targets import (
    WAYS,
    TargetOptions,
    admissible,
    closest_axis,
    standoffs,
    target_options,
)
from mjx_grasp.handoff.clearance import DistanceGrid, distance_grid
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.ik import IkSolution, make_ik
from mjx_grasp.handoff.report import OUTCOMES, ObjectReport
from mjx_grasp.handoff.sampling import draw_candidates, sample_object_poses
from mjx_grasp.handoff.starts import build_library, choose_starts, make_ranking
from mjx_grasp.heatmap import heatmap_of
from mjx_grasp.robot.arrays import robot_arrays
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.scene import build_scene

if TYPE_CHECKING:
    from mjx_grasp.objects.model import ObjectModel
    from mjx_grasp.robot.spec import RobotSpec


@dataclass
class _Accepted:
    """A state that passed, and what orders the choice among many."""

    pose: int
    rank: int  # among the candidates of its pose
    candidate: int
    row: dict[str, np.ndarray]


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
        arrays = robot_arrays(robot)
        self._library = build_library(arrays, config.ik.library_size, config.sampling, config.seed)
        self._rank = make_ranking(arrays, config.ik.clearance)
        self._solve = make_ik(arrays, config.ik)

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
        candidates = vertex_candidates(heatmap_of(obj, self._robot.hand))
        suits = np.asarray(candidates.valid & (candidates.score >= config.sampling.min_score))
        report.eligible_candidates = int(suits.sum())
        chosen: list[_Accepted] = []
        if suits.any():
            checker = CollisionChecker(build_scene([obj], self._robot))
            grid = distance_grid(obj.pieces)
            options = target_options(candidates, config.targets)
            accepted: list[_Accepted] = []
            for _ in range(config.max_rounds):
                accepted += self._round(obj, candidates, options, suits, checker, grid, report, rng)
                chosen = self._choose(accepted)
                progress(len(chosen))
                if len(chosen) == config.per_object:
                    break
        report.kept = len(chosen)
        report.seconds = time.perf_counter() - started
        return self._as_set(obj, chosen), report

    def _round(
        self, obj, candidates, options, suits, checker, grid, report, rng
    ) -> list[_Accepted]:
        """Draws poses and candidates, solves them all, checks what converged."""
        sampling, targets, ik = self._config.sampling, self._config.targets, self._config.ik
        pos, quat = sample_object_poses(obj.resting, sampling.poses_per_round, sampling, rng)
        # Rounded to what the file holds, so that exactly the saved state is checked.
        pos, quat = np.asarray(pos, np.float32), np.asarray(quat, np.float32)
        first_pose = report.poses
        report.poses += len(pos)
        rotations = np.array([_matrix(q) for q in quat])
        high = np.asarray(_admissible(candidates, options, pos, rotations, targets))
        score, thumb = np.asarray(candidates.score), np.asarray(candidates.thumb)
        pairs = []
        for k in range(len(pos)):
            allowed = suits & high[k].any(axis=1)
            drawn = draw_candidates(score, thumb, allowed, sampling, rng)
            report.poses_without_candidate += len(drawn) == 0
            pairs += [(k, rank, c, rotations[k], high[k, c]) for rank, c in enumerate(drawn)]
        if not pairs:
            return []
        report.sampled += len(pairs)

        # Filled up to one size with repetitions, for one compilation.
        size = sampling.poses_per_round * sampling.candidates_per_pose
        filled = [pairs[n % len(pairs)] for n in range(size)]
        pose, rank, candidate, rotation, usable = map(np.array, zip(*filled, strict=True))
        ways = jax.tree.map(lambda x: np.asarray(x).reshape(-1, WAYS, *x.shape[1:]), options)
        contact = np.einsum("nij,nvkj->nvki", rotation, ways.position[candidate])
        contact = contact + pos[pose][:, None, None]
        normal = np.einsum("nij,nkj->nki", rotation, ways.normal[candidate, 0])
        goal = np.asarray(standoffs(contact, normal[:, None], targets))
        inward = np.broadcast_to(-normal[:, None], goal.shape)
        p_wo, R_wo = np.asarray(pos[pose], np.float32), np.asarray(rotation, np.float32)
        variant, entry = choose_starts(
            self._library, self._rank, goal, inward, usable, p_wo, R_wo, grid, ik.restarts
        )
        rows = np.arange(size)[:, None]
        solution = self._solve_all(
            grid,
            goal[rows, variant],
            inward[rows, variant],
            self._library.q[entry],
            np.repeat(p_wo[:, None], ik.restarts, axis=1),
            np.repeat(R_wo[:, None], ik.restarts, axis=1),
        )

        # What the selection would take for u does not depend on heights.
        spreads = ways.usable[candidate][:, None, ::2]
        approach = np.einsum("nji,nrj->nri", rotation, solution.approach)
        axis = np.asarray(closest_axis(np.abs(approach), spreads))
        accepted = []
        for n in range(len(pairs)):
            start, outcome = self._first_clear(
                jax.tree.map(lambda leaf, n=n: leaf[n], solution),
                axis[n],
                variant[n],
                usable[n],
                lambda q, n=n: checker.reason(q, pos[pose[n]], quat[pose[n]]),
            )
            report.converged += outcome not in ("unreachable", "limits")
            if outcome is not None:
                report.rejected[outcome] += 1
                continue
            report.feasible += 1
            row = {
                "object_pos": pos[pose[n]],
                "object_quat": quat[pose[n]],
                "q": solution.q[n, start],
                "target_pos": contact[n, variant[n, start]],
                "target_normal": normal[n],
                "score": score[candidate[n]],
                "residual": solution.residual[n, start],
            }
            at = first_pose + int(pose[n])
            accepted.append(_Accepted(at, int(rank[n]), int(candidate[n]), row))
        return accepted

    def _solve_all(self, grid: DistanceGrid, *inputs: np.ndarray) -> IkSolution:
        """Solves all starts of all pairs; arrays in and out are [pairs, starts, …]."""
        shape = inputs[0].shape[:2]
        flat = [np.asarray(x, np.float32).reshape(-1, *x.shape[2:]) for x in inputs]
        solved = map(np.asarray, self._solve(*flat, grid))
        return IkSolution(*(leaf.reshape(*shape, *leaf.shape[1:]) for leaf in solved))

    def _first_clear(self, solution, axis, variant, usable, collision):
        """The best start that is refused for nothing, or the reason of the one that got farthest.

        The reach axis must be the one that the selection would take with this palm (method §2).
        """
        farthest = -1
        for start in np.argsort(solution.cost, kind="stable"):
            if not usable[variant[start]]:
                continue
            if solution.residual[start].max() > self._config.ik.tolerance:
                outcome = "limits" if solution.at_limit[start] else "unreachable"
            elif variant[start] // 2 != axis[start]:
                outcome = "reach-axis"
            else:
                outcome = collision(solution.q[start])
                if outcome is None:
                    return start, None
            farthest = max(farthest, OUTCOMES.index(outcome))
        return None, OUTCOMES[farthest]

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

    def _as_set(self, obj: ObjectModel, chosen: list[_Accepted]) -> HandoffSet:
        joints = len(self._robot.joints)
        empty = {
            "object_pos": (3,),
            "object_quat": (4,),
            "q": (joints,),
            "target_pos": (3, 3),
            "target_normal": (3, 3),
            "score": (),
            "residual": (3,),
        }
        arrays = {
            name: np.array([state.row[name] for state in chosen], np.float32).reshape(-1, *tail)
            for name, tail in empty.items()
        }
        return HandoffSet(
            object_index=np.zeros(len(chosen), np.int32),
            **arrays,
            object_names=(obj.name,),
            object_content_hash=(obj.content_hash,),
            kind="ik",
            robot=self._robot.identity,
        )


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


def _matrix(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat.astype(np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
