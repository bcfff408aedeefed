"""A demo from its settings to its files: heatmap, anchor, plans, grasp, film, page."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.config import BUDGET_N
from mjx_grasp.evaluation.grasps.kept import Trace
from mjx_grasp.evaluation.grasps.problems import Away, draw_problem
from mjx_grasp.evaluation.grasps.results import grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.evaluation.grasps.scenario import NOMINAL, Scenario, load_scenario
from mjx_grasp.evaluation.grasps.trials import home_tips
from mjx_grasp.evaluation.trajectory import record, save_trajectory
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.heatmap.compute import heatmap_of, heatmap_surface
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import GRAVITY, ObjectModel, load_objects, object_shape
from mjx_grasp.objects.momentum import net_wrench
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.pressing import budget_for
from mjx_grasp.posture.body import FINGERS
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.records.atomic import check_new_folder, replacing, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import Scene, build_scene
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.demo.page import Shown, demo_page
from mjx_grasp.viz.demo.place import Steered, place_of, steered_to
from mjx_grasp.viz.demo.plots import Curves
from mjx_grasp.viz.demo.result import result_of, stages_of, tries_of
from mjx_grasp.viz.demo.stage import FOCUS, Skin, stage_model
from mjx_grasp.viz.heatmap import Subject
from mjx_grasp.viz.rendering import RenderError, VideoConfig, render_in_subprocess

_STEPS = 6


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
    page = config.out / "index.html"
    if page.exists() and not (config.out / "result.json").exists():
        raise InputError("--out", f"{page}, which no demo has written", "another folder")
    name, scenario = load_scenario(config.scenario)
    _check_object(config.object, name, scenario)
    made = provenance(config.seed)
    robot = load_robot(config.robot).mounted(-scenario.table_height)
    file = closing_policy(config.controller, config.policy, robot)
    budget, approach = config.force_budget, scenario.approach
    grasper = loaded_grasper(robot, file, budget, config.steers, approach)
    assert grasper.planner is not None
    # Before its convex pieces are worked out, which may take a while.
    place = place_of(object_shape(config.object, config.objects_dir), config)
    (obj,) = load_objects([config.object], config.objects_dir, weight=config.weight)
    if (doubt := too_heavy(scenario.mass_scale * obj.mass, max(budget, BUDGET_N))) is not None:
        console.print(f"{obj.name}: {doubt}", markup=False, highlight=False)
    with counting_progress(console, transient=True) as bar:
        clock = _Clock(bar)
        with clock.step("heatmap"):
            steered = steered_to(heatmap_of(obj, robot.hand), place, config, robot.hand)
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
        stages = stages_of(trace, grasper.dt)
        contacts = np.asarray(end.state.closing.contacts.position[0], np.float64)
        tries = tries_of(stages, trace, scene, steered.anchor, grasper.dt)
        config.out.mkdir(parents=True, exist_ok=True)
        with clock.step("film"):
            skin = _skin(obj, steered, contacts, end.obstacles[0])
            problem_of_film = _film(scene, skin, trace, grasper.dt, config.out)
        result = result_of(obj, steered, row, stages, tries, contacts, end, clock.seconds, made)
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


def _title(obj: ObjectModel, steered: Steered, happens: str | None) -> str:
    stand_in = " (stand-in)" if obj.source == "parametric" else ""
    words = [obj.name.replace("_", " ") + stand_in, steered.source, happens]
    return ", ".join(word for word in words if word)


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
