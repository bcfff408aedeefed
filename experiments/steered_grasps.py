"""What steering achieves, and what it costs: whole grasps with and without it, from the same poses.

Objects lie at random on the table and are grasped "near the top", "by the handle" and so on: every
side, every named part. Each grasp is made twice, steered to the contacts and by default, and the
distance of the place from the contacts is measured: of those of the first try, of those of the
last, and of the pads when the lift begins. A side may lie on the table; it is asked for all
the same: how high the place is says so, how near the nearest contacts are that can be used in that
pose at all, and how near those of them that hold the object easily. The shipped policy closes.
`--processes 8` shares them out over as many cores, some trials at a time, and a run that was killed
goes on after those that it had finished.

  python experiments/steered_grasps.py --objects-dir SCANS
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.evaluation.grasps.config import warn_without_gpu
from mjx_grasp.evaluation.grasps.kept import GraspEnd, Trace
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.evaluation.grasps.results import grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.trials import GraspProblem
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import turned, turned_back
from mjx_grasp.grasp.candidates import Candidates, vertex_candidates
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.targets import admissible, target_options
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.heatmap.steering import Heatmap, steer_to
from mjx_grasp.language.grounding import Anchor, target_of
from mjx_grasp.language.parts import SIDES, PartGrounder
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.pipeline.assemble import whole_grasps
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.library import Library
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.planning import held_easily, start_library
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Count, Seed, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.engines import Engine, make_physics
from mjx_grasp.sim.physics import Physics
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.demo.result import from_anchor

SCHEMA = "mjx_grasp.steered_grasps/4"
_TEN = (
    *("potted_meat_can", "sugar_box", "pitcher_base_scaled", "mustard_bottle", "cracker_box"),
    *("bleach_cleanser", "power_drill", "mug", "banana", "pear"),
)
_FACES = tuple(side for side in SIDES if side != "middle")
DEFAULT = "default"
WAYS = (DEFAULT, "contacts")
_PERCENT = 100
_TOGETHER = 8
"""Trials of a part in native MuJoCo: several at once cost less each, and many processes are to
share them."""


@dataclass(frozen=True)
class SteeredConfig(Spread):
    """What to grasp."""

    out: Path = Path("experiments/results/steered_grasps.json")
    objects: tuple[str, ...] = _TEN
    """names of the catalogue"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    engine: Engine = "mujoco"
    """what steps the physics: mujoco (native, in threads) or mjx (Warp, on a GPU)"""
    poses: Count = 1
    """random ones of the object for each place [-]"""
    seed: Seed = 0
    """of the poses and plans"""


class Place(NamedTuple):
    """Where one trial is to grasp."""

    index: int
    """of the object"""
    kind: str
    """`part` or `side`"""
    name: str
    anchor: Anchor


def places_of(index: int, obj: ObjectModel) -> list[Place]:
    """Every side and every named part of an object."""
    target = target_of(obj.name, obj.mesh, obj.parts)
    asked = [*(("part", part) for part in obj.parts), *(("side", side) for side in _FACES)]
    found = ((kind, name, PartGrounder().ground(name, target)) for kind, name in asked)
    # A part hides a side of its name.
    return [Place(index, k, n, anchor) for k, n, anchor in found if anchor.source == f"{k}: {n}"]


def contacts_in_object(
    grasper: Grasper, physics: Physics, trace: Trace
) -> Float[np.ndarray, "3 w 3 3"]:
    """Chosen contacts at first and last handoff, pads as the last lift begins; object frame.

    They are nan in trials that do not come so far.
    """
    at, worlds = physics.scene.addresses, trace.phase.shape[1]
    first, chosen, achieved = found = np.full((3, worlds, 3, 3), np.nan)
    pads = jax.jit(lambda q: grasper.reacher.body.kinematics.motion(q).pos[FINGERS:PALM])
    for w in range(worlds):
        phase, qpos = trace.phase[:, w], trace.qpos[:, w]
        lifting = phase == Phase.LIFTING
        begins = np.flatnonzero(lifting & ~np.append(False, lifting[:-1]))[-1:]
        before = phase[: begins[0]] if len(begins) else phase
        for kept, tick, points in (
            (first, np.flatnonzero(phase == Phase.CLOSING)[:1], trace.contacts[:, w]),
            (chosen, np.flatnonzero(before == Phase.CLOSING)[-1:], trace.contacts[:, w]),
            (achieved, begins, None),
        ):
            if len(tick):
                t = int(tick[0])
                pose = qpos[t, at.object_qpos]
                seen = points[t] if points is not None else pads(qpos[t, at.robot_qpos])
                R_wo = so3.quat_to_mat(jnp.asarray(pose[3:]))
                kept[w] = np.asarray(turned_back(R_wo, jnp.asarray(seen) - pose[:3]))
    return found


def rows_of(
    way: str,
    places: list[Place],
    within: list[Nearest],
    names: list[str],
    ran: tuple[GraspEnd, Trace],
    grasper: Grasper,
    physics: Physics,
    problem: GraspProblem,
) -> list[dict[str, Any]]:
    """One row per trial."""
    end, trace = ran
    ends = grasp_rows(names, problem, end, trace, grasper.dt)
    rows = []
    contacts = zip(*contacts_in_object(grasper, physics, trace), strict=True)
    heights = heights_of(places, problem)
    for place, row, height, nearest, apart in zip(
        places, ends, heights, within, contacts, strict=True
    ):
        first, chosen, achieved = (_distance(points, place.anchor) for points in apart)
        rows.append(
            {
                "object": names[place.index],
                "kind": place.kind,
                "place": place.name,
                "height_mm": round(1e3 * float(height), 1),
                "nearest_mm": nearest.usable,
                "nearest_easy_mm": nearest.easy,
                "steering": way,
                "outcome": row.outcome,
                "force_mean_n": row.force_mean_n,
                "first_mm": first,
                "chosen_mm": chosen,
                "achieved_mm": achieved,
            }
        )
    return rows


def heights_of(places: list[Place], problem: GraspProblem) -> Float[np.ndarray, " w"]:
    """How high above the table each place is at first [m]."""
    points = jnp.asarray(np.stack([place.anchor.point for place in places]), jnp.float32)
    turn = so3.quat_to_mat(jnp.asarray(problem.quat))
    return np.asarray(problem.p_wo[:, 2] + turned(turn, points)[:, 2])


class Nearest(NamedTuple):
    """Mean distance of the nearest contacts from a place, None if there are none [mm]."""

    usable: float | None
    """of those that the selection would take where the object lies"""
    easy: float | None
    """of those of them that hold it easily, see `PlanConfig.easily`"""


def nearest_contacts(
    known: Known,
    heatmap: Heatmap,
    place: Place,
    p_wo: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
) -> Nearest:
    """How near contacts can be at all; whether there is a posture to reach them is not asked."""
    least, settings = whole_grasps().selection.min_score, whole_grasps(steered=True)
    assert settings.plan is not None
    plan, targets = settings.plan, settings.selection.targets
    candidates = vertex_candidates(heatmap)
    good = candidates.valid & (jnp.asarray(heatmap.score_without_com) >= least)
    found = _usable(plan, targets, known, candidates, good, jnp.asarray(p_wo), jnp.asarray(quat))
    contacts, *each = map(np.asarray, found)
    apart = np.linalg.norm(contacts - place.anchor.point, axis=-1).mean(axis=-1)
    near = (1e3 * apart[counted] for counted in each)
    return Nearest(*(round(float(some.min()), 1) if some.size else None for some in near))


@functools.partial(jax.jit, static_argnames=("plan", "targets"))
def _usable(
    plan: PlanConfig,
    targets: TargetConfig,
    known: Known,
    candidates: Candidates,
    good: Bool[Array, " n"],
    p_wo: Float[Array, " 3"],
    quat: Float[Array, " 4"],
) -> tuple[Float[Array, "v 3 3"], Bool[Array, " v"], Bool[Array, " v"]]:
    """Contacts in the object's frame, which of them can be used, and which hold it easily.

    Compiled, as JAX keeps what its loops outside of compiled functions have closed over.
    """
    ways, R_wo = target_options(candidates, targets), so3.quat_to_mat(quat)
    usable = admissible(candidates, ways, p_wo, R_wo, targets) & good[ways.candidate]
    around = Surroundings.still(known.shape, p_wo, R_wo, known.com, known.weight)
    return ways.position, usable, held_easily(plan, ways, usable, around)


def _distance(contacts: Float[np.ndarray, "3 3"], anchor: Anchor) -> float | None:
    """Mean distance of the contacts from the anchor."""
    if np.isnan(contacts).any():
        return None
    return from_anchor(anchor.point, contacts)


class Steered:
    """What every process that grasps needs.

    Args:
        config: Objects, and the seed.
        progress: Told which share of a part of the trials is done.

    Raises:
        InputError, FileError: The objects cannot be had.
    """

    def __init__(
        self, config: SteeredConfig, progress: Callable[[float], None] = lambda share: None
    ):
        self._config, self._progress, self._robot = config, progress, load_robot()
        self.policy = closing_policy("policy", None, self._robot)
        self._objects = objects = list(load_objects(config.objects, config.objects_dir))
        self._places = [
            place
            for k, obj in enumerate(objects)
            for place in places_of(k, obj)
            for _ in range(config.poses)
        ]
        counts = [sum(place.index == k for place in self._places) for k in range(len(objects))]
        self._scene = build_scene(objects, self._robot)
        drawn = [
            draw_problem(self._scene, n, config.seed, objects=[k]) for k, n in enumerate(counts)
        ]
        self._problem = GraspProblem(
            object_index=np.repeat(np.arange(len(objects)), counts),
            p_wo=np.concatenate([part.p_wo for part in drawn]),
            quat=np.concatenate([part.quat for part in drawn]),
            headings=np.concatenate([part.headings for part in drawn]),
            seed=np.concatenate([part.seed for part in drawn]),
        )
        # Each is made once: what is compiled for one controller is not for its like.
        self._heatmap = functools.cache(lambda k: heatmap_of(objects[k], self._robot.hand))
        self._grasper = functools.cache(self._new_grasper)
        self._physics = functools.cache(self._new_physics)
        self._together = len(self._places) if config.engine == "mjx" else _TOGETHER

    @property
    def meshes(self) -> dict[str, str]:
        """What tells the objects' meshes from others of the same names."""
        return {obj.name: obj.content_hash for obj in self._objects}

    def jobs(self) -> list[tuple[str, int]]:
        """Each way, and the first trial of each part of them."""
        return [(way, k) for way in WAYS for k in range(0, len(self._places), self._together)]

    def rows(self, job: tuple[str, int]) -> list[dict[str, Any]]:
        """A part of the trials in one way, from the poses and with the draws of the other way."""
        way, first = job
        part = slice(first, first + self._together)
        places = self._places[part]
        problem = GraspProblem(*(values[part] for values in self._problem))
        known, within = [], []
        for place, *pose in zip(places, problem.p_wo, problem.quat, strict=True):
            heatmap, anchor = self._heatmap(place.index), place.anchor
            score = None
            if way != DEFAULT:
                score = steer_to(heatmap, anchor.point, anchor.size)
            known.append(known_object(self._objects[place.index], self._robot, heatmap, score))
            within.append(nearest_contacts(known[-1], heatmap, place, *pose))
        grasper, library = self._grasper(way)
        physics = self._physics(len(places), grasper.dt)
        ran = grasp_all(
            grasper, library, physics, known, problem, which=np.arange(len(places)),
            progress=self._progress,
        )  # fmt: skip
        names = [obj.name for obj in self._objects]
        return rows_of(way, places, within, names, ran, grasper, physics, problem)

    def _new_grasper(self, way: str) -> tuple[Grasper, Library]:
        grasper = loaded_grasper(self._robot, self.policy, steered=way != DEFAULT)
        assert grasper.planner is not None
        return grasper, start_library(grasper.reacher.body, grasper.planner.config)

    def _new_physics(self, worlds: int, dt: float) -> Physics:
        return make_physics(self._config.engine, self._scene, worlds, dt)


def main(config: SteeredConfig) -> None:
    """Grasps in both ways and writes."""
    check_writable("--out", config.out)
    made = provenance(config.seed)
    policy = closing_policy("policy", None, load_robot())
    identity = {"schema": SCHEMA, "config": to_record(unspread(config))}
    identity |= {"sha256": file_digests(policy=policy), "device": jax.default_backend()}
    rows, console = list[dict[str, Any]](), Console(stderr=True)
    warn_without_gpu(config.engine, console)
    with counting_progress(console) as bar:
        one = bar.add_task("", total=_PERCENT, visible=config.alone)
        own = Steered(config, lambda share: bar.update(one, completed=round(_PERCENT * share)))
        identity["meshes"] = own.meshes
        journal = Journal(config.out, identity, made["git"])
        jobs = own.jobs()
        parts = bar.add_task("parts of the trials", total=len(jobs))
        setup = (lambda: own) if config.alone else functools.partial(Steered, config)
        named = [(json.dumps(job), job) for job in jobs]
        for found in journaled(config, Steered.rows, named, setup, journal, kind=itemgetter(0)):
            rows += found
            bar.update(parts, advance=1)
    write_json(config.out, identity | {"rows": rows, "provenance": made})
    journal.close()
    Console().print(f"written: {config.out}, {len(rows)} trials")


if __name__ == "__main__":
    import steered_grasps as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.SteeredConfig, description=__doc__)))
