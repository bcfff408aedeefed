"""A demo from its settings to its files: heatmap, anchor, plans, grasp, film, page."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.config import BUDGET_N
from mjx_grasp.evaluation.grasps.kept import GraspEnd, Trace
from mjx_grasp.evaluation.grasps.problems import Away, draw_problem
from mjx_grasp.evaluation.grasps.results import GraspRow, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import NOMINAL, Scenario, load_scenario
from mjx_grasp.evaluation.grasps.trials import home_tips
from mjx_grasp.evaluation.trajectory import record, save_trajectory
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import turned_back
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.heatmap.compute import heatmap_of, heatmap_surface
from mjx_grasp.heatmap.steering import Heatmap, steer_to
from mjx_grasp.heatmap.summary import LEAST
from mjx_grasp.language.grounding import Anchor, target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import GRAVITY, ObjectModel, load_objects
from mjx_grasp.objects.momentum import net_wrench
from mjx_grasp.pipeline.known import check_graspable, known_object
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.pressing import budget_for
from mjx_grasp.posture.body import FINGERS
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_new_folder, replacing, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.robot.spec import HandSpec, load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import Scene, build_scene
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.demo.page import Shown, demo_page
from mjx_grasp.viz.demo.plots import Curves, Stage
from mjx_grasp.viz.demo.stage import FOCUS, Skin, stage_model
from mjx_grasp.viz.heatmap import Subject
from mjx_grasp.viz.rendering import RenderError, VideoConfig, render_in_subprocess

SCHEMA = "mjx_grasp.demo/1"
_STEPS = 6
_BRIGHTEST = 0.99
_FARTHEST = 0.5  # an anchor from the object's box, of the object's largest extent
_ASIDE_MM = 20.0
"""Contacts so much farther from the place than the nearest ones are not what was asked for."""


class Steered(NamedTuple):
    """Where the object is to be grasped."""

    heatmap: Heatmap
    score: Float[np.ndarray, " v"]
    """steered, the best is 1"""
    anchor: Float[np.ndarray, " 3"] | None
    """object frame [m]"""
    source: str
    """of the anchor, in words"""

    @property
    def shade(self) -> Float[np.ndarray, " v"]:
        """Scores as they are coloured: the best hundredth has the brightest, void is NaN."""
        valid = np.asarray(self.heatmap.valid)
        top = max(float(np.quantile(self.score[valid], _BRIGHTEST)), 1e-6)
        return np.where(valid, np.minimum(self.score / top, 1.0), np.nan)

    @property
    def best(self) -> Float[np.ndarray, "3 3"]:
        """The contacts with the best score, whether or not the hand gets there [m]."""
        k = int(np.argmax(np.where(self.heatmap.valid, self.score, -np.inf)))
        return np.vstack([self.heatmap.thumb[k], self.heatmap.wrap[k]])


class _Clock:
    """How long each step takes, shown as it goes."""

    def __init__(self, bar: Progress):
        self.seconds: dict[str, float] = {}
        self._bar, self._job = bar, bar.add_task("demo", total=_STEPS)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        self._bar.update(self._job, description=name)
        started = time.perf_counter()
        yield
        self.seconds[name] = round(time.perf_counter() - started, 2)
        self._bar.advance(self._job)


def run_demo(config: DemoConfig, console: Console) -> dict[str, Any]:
    """Makes a demo and writes its folder.

    Returns:
        What `result.json` holds.

    Raises:
        InputError, GroundingError, FileError: A setting or file that cannot work; nothing is
            written then.
    """
    check_new_folder("--out", config.out)
    name, scenario = load_scenario(config.scenario)
    _check_object(config.object, name, scenario)
    made = provenance(config.seed)
    robot = load_robot(config.robot).mounted(-scenario.table_height)
    file = closing_policy(config.controller, config.policy, robot)
    budget, approach = config.force_budget, scenario.approach
    grasper = loaded_grasper(robot, file, budget, config.steers, approach)
    assert grasper.planner is not None
    (obj,) = _one(load_objects([config.object], config.objects_dir, weight=config.weight), config)
    if (doubt := too_heavy(scenario.mass_scale * obj.mass, max(budget, BUDGET_N))) is not None:
        console.print(f"{obj.name}: {doubt}", highlight=False)
    place = _place(obj, config)
    with counting_progress(console, transient=True) as bar:
        clock = _Clock(bar)
        with clock.step("heatmap"):
            steered = _steered(heatmap_of(obj, robot.hand), place, config, robot.hand)
        with clock.step("start library"):
            library = start_library(grasper.reacher.body, grasper.planner.config)
        with clock.step("plan and grasp"):
            away = Away(home_tips(grasper), scenario.away) if scenario.away else None
            scene = build_scene([obj], robot)
            problem = draw_problem(scene, 1, config.seed, away=away)
            score = jnp.asarray(steered.score) if config.steers else None
            known = [known_object(obj, robot, steered.heatmap, score)]
            physics = NativePhysics(scene, grasper.dt, threads=1)
            end, trace = grasp_all(grasper, library, physics, known, problem, [scenario])
        (row,) = grasp_rows([obj.name], problem, end, trace, grasper.dt)
        stages = _stages(trace, grasper.dt)
        contacts = np.asarray(end.state.closing.contacts.position[0], np.float64)
        tries = _tries(stages, trace, scene, steered.anchor, grasper.dt)
        config.out.mkdir(parents=True, exist_ok=True)
        with clock.step("film"):
            skin = _skin(obj, steered, contacts, end.obstacles[0])
            problem_of_film = _film(scene, skin, trace, grasper.dt, config.out)
        result = _result(obj, steered, row, stages, tries, contacts, end, clock.seconds, made)
        result["scenario"] = {"name": name, "description": scenario.description}
        knows_budget = grasper.policy is not None and grasper.policy.observation.budget
        given = budget_for(scenario.weighed * known[0].weight, budget, grasper.config)
        result["closing"] = {
            "controller": config.controller,
            "force_budget_n": round(float(given), 3) if knows_budget else None,
            "sha256": file_digests(policy=file),
        }
        with clock.step("page"):
            shown = Shown(
                title=_title(obj, steered, scenario.description if name != NOMINAL else None),
                subject=_subject(obj, steered, contacts),
                curves=_curves(trace, obj, scene, scenario.mass_scale, grasper.dt),
                stages=stages,
                video=None if problem_of_film else config.out / "grasp.mp4",
                video_problem=problem_of_film,
                result=result,
            )
            with replacing(config.out / "index.html") as temporary:
                temporary.write_text(demo_page(shown), encoding="utf-8")
        with clock.step("result"):
            write_json(config.out / "result.json", result)
    return result


def _check_object(asked: str, name: str, scenario: Scenario) -> None:
    """Refuses an object that a scenario is not of."""
    if scenario.objects and not set(resolve([asked])) <= set(resolve(scenario.objects)):
        own = ", ".join(scenario.objects)
        raise InputError("object", asked, f"{own}, as the scenario {name} is of that alone")


def too_heavy(mass: float, force: float) -> str | None:
    """Why an object may well stay on the table; None of one that the hand can carry.

    Args:
        mass: Its own [kg].
        force: Mean of what each finger may press with [N].
    """
    friction = ContactConfig().friction
    most = FINGERS * friction * force / GRAVITY
    if mass <= most:
        return None
    return (
        f"{mass:.3g} kg; fingers that press with {force:g} N each carry about {most:.2g} kg by a "
        f"friction of {friction:g}, so it may well stay where it is"
    )


def _one(objects: Any, config: DemoConfig) -> tuple[ObjectModel, ...]:
    found = tuple(objects)
    if len(found) != 1:
        raise InputError("object", config.object, f"one object, not {len(found)}")
    return found


def _title(obj: ObjectModel, steered: Steered, happens: str | None) -> str:
    stand_in = " (stand-in)" if obj.source == "parametric" else ""
    words = [obj.name.replace("_", " ") + stand_in, steered.source, happens]
    return ", ".join(word for word in words if word)


def _place(obj: ObjectModel, config: DemoConfig) -> Anchor | None:
    if config.anchor is not None:
        point, (low, high) = np.asarray(config.anchor, np.float64), obj.mesh.bounds
        margin = _FARTHEST * float(obj.mesh.extents.max())
        if (point < low - margin).any() or (point > high + margin).any():
            lies = " to ".join(str(np.round(corner, 3).tolist()) for corner in (low, high))
            near = f"a point [m] near {obj.name}, which lies within {lies}"
            raise InputError("--anchor", config.anchor, near)
        return Anchor(point, "by a point")
    if config.instruction is None:
        return None
    target = target_of(obj.name, obj.mesh, obj.parts)
    found = PartGrounder().ground(config.instruction, target)
    return replace(found, source=f"“{config.instruction}” ({found.source})")


def _steered(heatmap: Heatmap, place: Anchor | None, config: DemoConfig, hand: HandSpec) -> Steered:
    score, anchor, source = heatmap.score, None, "anywhere good"
    check_graspable(config.object, float(jnp.max(heatmap.score_without_com)), hand, LEAST)
    if place is not None:
        anchor, source = place.point, place.source
        score = steer_to(heatmap, anchor, place.size, config.sigma, config.steering)
        if not score.any():  # all too far away for its numbers
            asked = config.instruction if config.anchor is None else config.anchor
            field = "--instruction" if config.anchor is None else "--anchor"
            raise InputError(field, asked, "a place nearer to a grasp, or a larger --sigma")
    best = float(jnp.max(score))
    check_graspable(config.object, best, hand)
    # Far from the middle of the object all scores are low: what counts is which is the best.
    return Steered(heatmap, np.asarray(score / best, np.float64), anchor, source)


def _stages(trace: Trace, dt: float) -> list[Stage]:
    """The phases one after the other."""
    phase = np.asarray(trace.phase)[:, 0]
    starts = np.flatnonzero(np.diff(phase, prepend=-1))
    ends = [*starts[1:].tolist(), len(phase)]
    return [
        Stage(Phase(int(phase[a])).name.lower(), round(a * dt, 3), round(b * dt, 3))
        for a, b in zip(starts.tolist(), ends, strict=True)
    ]


def _tries(
    stages: list[Stage],
    trace: Trace,
    scene: Scene,
    anchor: Float[np.ndarray, " 3"] | None,
    dt: float,
) -> list[dict[str, float | None]]:
    """When the hand closed, and how far from the place the contacts were that it closed on."""
    found = []
    for stage in stages:
        if stage.name == Phase.CLOSING.name.lower():
            tick = round(stage.start / dt)
            pose = jnp.asarray(trace.qpos)[tick, 0, scene.addresses.object_qpos]
            contacts = turned_back(so3.quat_to_mat(pose[3:]), trace.contacts[tick, 0] - pose[:3])
            apart = from_anchor(anchor, np.asarray(contacts, np.float64))
            found.append({"start_s": stage.start, "from_anchor_mm": apart})
    return found


def _skin(
    obj: ObjectModel,
    steered: Steered,
    contacts: Float[np.ndarray, "3 3"],
    obstacles: Float[np.ndarray, "k 4"],
) -> Skin:
    return Skin(
        np.asarray(steered.heatmap.vertices, np.float64),
        np.asarray(heatmap_surface(obj.mesh).faces),
        np.nan_to_num(steered.shade),
        contacts,
        steered.anchor,
        obstacles,
    )


def _film(scene: Scene, skin: Skin, trace: Trace, dt: float, out: Path) -> str | None:
    """Writes the trajectory and `grasp.mp4`; the reason where nothing can be rendered here."""
    motion = record(
        stage_model(scene, skin), np.asarray(trace.qpos, np.float64)[:, 0], dt, FOCUS,
        scene.robot.identity,
    )  # fmt: skip
    path = out / "grasp.npz"
    save_trajectory(path, motion)
    try:
        render_in_subprocess(VideoConfig(path, out=out / "grasp.mp4"))
    except RenderError as error:
        return str(error)
    return None


def _subject(obj: ObjectModel, steered: Steered, contacts: Float[np.ndarray, "3 3"]) -> Subject:
    heatmap = steered.heatmap
    return Subject(
        vertices=np.asarray(heatmap.vertices, np.float64),
        faces=np.asarray(heatmap_surface(obj.mesh).faces),
        normals=np.asarray(heatmap.normals, np.float64),
        score=steered.shade,
        thumb=contacts[0],
        wrap=contacts[1:],
        anchor=steered.anchor,
    )


def _curves(trace: Trace, obj: ObjectModel, scene: Scene, mass_scale: float, dt: float) -> Curves:
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], trace)
    quat = one.qpos[:, scene.addresses.object_qpos[3:]]
    force, moment = net_wrench(obj, quat, one.object_vel, dt)
    time_s = dt * (1 + np.arange(len(one.phase)))
    closing = (one.phase >= Phase.CLOSING)[:, None]
    return Curves(
        time=time_s,
        tip_error=one.tip_error,
        touching=one.touching,
        observed=one.observed & closing,
        felt=np.where(closing, one.felt, 0.0),
        force=one.force,
        rise=one.rise,
        net_force=mass_scale * np.linalg.norm(force, axis=-1),
        net_moment=mass_scale * np.linalg.norm(moment, axis=-1),
    )


def from_anchor(
    anchor: Float[np.ndarray, " 3"] | None, contacts: Float[np.ndarray, "3 3"]
) -> float | None:
    """Mean distance of contacts from the place that was asked for [mm]; None of no place."""
    if anchor is None:
        return None
    return round(1e3 * float(np.linalg.norm(contacts - anchor, axis=1).mean()), 1)


def placed(tries: list[dict[str, float | None]], best_mm: float | None) -> dict[str, Any]:
    """How near to the place the contacts of the last try were, and whether that is as asked.

    Nothing is said of a hand that has not closed, or without a place.

    Args:
        tries: From `_tries`.
        best_mm: Distance of the contacts with the best score, see `from_anchor` [mm].
    """
    apart = tries[-1]["from_anchor_mm"] if tries else None
    near = None if apart is None or best_mm is None else apart <= best_mm + _ASIDE_MM
    return {"from_anchor_mm": apart, "at_best_mm": best_mm, "as_asked": near}


def _result(
    obj: ObjectModel,
    steered: Steered,
    row: GraspRow,
    stages: list[Stage],
    tries: list[dict[str, float | None]],
    contacts: Float[np.ndarray, "3 3"],
    end: GraspEnd,
    seconds: dict[str, float],
    made: dict[str, Any],
) -> dict[str, Any]:
    """What `result.json` holds."""
    normals = np.asarray(end.state.closing.contacts.normal[0], np.float64)
    return {
        "schema": SCHEMA,
        "object": obj.name,
        "mesh": obj.source,
        "mass_kg": round(obj.mass, 4),
        "asked": steered.source,
        "anchor_m": None if steered.anchor is None else np.round(steered.anchor, 4).tolist(),
        "success": row.outcome == "success",
        "phases": [stage._asdict() for stage in stages],
        "tries": tries,
        "contacts_m": np.round(contacts, 4).tolist(),
        **placed(tries, from_anchor(steered.anchor, steered.best)),
        "normals": np.round(normals, 4).tolist(),
        "grasp": asdict(row),
        "seconds": seconds,
        "provenance": made,
    }
