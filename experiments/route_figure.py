"""One grasp from the mesh to the lift, stage by stage: the first picture of the README.

  MUJOCO_GL=egl python experiments/route_figure.py --objects-dir SCANS

Everything in it is computed: the heatmap of the object, steered by an instruction; reaches for
several poses of the object, the commands of the reaching controller integrated; and closing and
lifting by the shipped policy in native MuJoCo from the postures in which the reaches hand off. The
picture shows one of the poses from which the object is lifted; the results file says what came of
all of them.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Int
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from renderer import check_backend
from small_png import write_png

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.trajectory import Trajectory, record_world
from mjx_grasp.evaluation.trials import paired_draws, record_trials
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.distance_field import distance_field
from mjx_grasp.geometry.signed_distance import DistanceField
from mjx_grasp.grasp.candidates import Candidates, from_heatmap
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.sampling import sample_object_poses
from mjx_grasp.heatmap.compute import heatmap_of, heatmap_surface
from mjx_grasp.heatmap.steering import Heatmap, steer_near
from mjx_grasp.language.grounding import target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.objects.model import ObjectModel, load_object
from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.controller import Reacher, ReachOutcome
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed, WholeNumber
from mjx_grasp.robot.spec import RobotSpec, load_robot
from mjx_grasp.sim.scene import Scene, build_scene
from mjx_grasp.tasks.assemble import build_world
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.viz import frames
from mjx_grasp.viz.camera import TURN_DEG, best_azimuth, look_at
from mjx_grasp.viz.heatmap import Picture, Subject, draw
from mjx_grasp.viz.raster import look_from

SCHEMA = "mjx_grasp.route/1"
STAGES = (
    ("Mesh", "a scan, or any mesh of yours"),
    ("Heatmap", "how well each point suits the thumb"),
    ("Steering", "“{instruction}”"),
    ("Three points", "for thumb, index and middle finger"),
    ("Reaching", "clear of object, table and itself"),
    ("Handoff", "each tip in front of its point"),
    ("Closing", "by a policy that feels its joints"),
    ("Lift", "scripted, corrected by the policy"),
)
_INK, _GREY = "#191923", "#5b6470"
_PIXELS = 380
_COLUMNS = 4
_CANDIDATES = 256  # of the heatmap, the best, of which reaching chooses
_LEAST_SCORE = 0.5  # of those, against the best one's: steering is to decide
_TICKS = 600  # of a reach
_AWAY_M = 0.15  # of the tips from their goals in the picture of reaching
_BEFORE_LIFT = 20  # ticks before the object has risen, in the picture of closing
_CROP = 0.72  # of a rendered picture's side, around the object
_ELEVATION = np.radians(30.0)


@dataclass(frozen=True)
class RouteConfig(CommandSettings):
    """What is grasped, and where."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    object: str = "tomato_soup_can"
    """one of the catalogue"""
    instruction: str = "near the top"
    """part or side of it"""
    sigma: Positive = 0.030
    """how near the grasp has to be to that [m]"""
    poses: Count = 12
    """of the object that are tried [-]"""
    seed: Seed = 0
    """of the poses"""
    shown: WholeNumber = 3
    """which of the poses that it is lifted from is drawn [-]"""
    out: Path = Path("docs/route.png")
    """the picture"""
    results: Path = Path("experiments/results/route.json")
    """what came of each pose"""
    max_kb: Count = 600
    """largest picture"""


class Poses(NamedTuple):
    """Where the object lies; world frame."""

    p_wo: Float[np.ndarray, "n 3"]
    quat: Float[np.ndarray, "n 4"]
    R_wo: Float[np.ndarray, "n 3 3"]


class Reaches(NamedTuple):
    """A reach for each pose, tick by tick."""

    q: Float[Array, "n t joints"]
    away: Float[Array, "n t"]
    """mean distance of the tips from their goals [m]"""
    error: Float[Array, "n t 3"]
    """of each tip [m]"""
    position: Float[Array, "n t 3 3"]
    """the three points, world [m]"""
    normal: Float[Array, "n t 3 3"]
    outcome: Int[Array, "n t"]


def main(config: RouteConfig) -> None:
    """Computes, draws and writes."""
    for flag, path in (("--out", config.out), ("--results", config.results)):
        check_writable(flag, path)
    check_backend()
    made = provenance(config.seed)  # before anything is written, so that the revision is not dirty
    robot, model = load_robot(), load_object(config.object, config.objects_dir)
    surface = heatmap_surface(model.mesh)
    heatmap = heatmap_of(model, robot.hand)
    target = target_of(config.object, model.mesh, model.parts)
    anchor = PartGrounder().ground(config.instruction, target).point
    score = steer_near(heatmap, jnp.asarray(anchor), config.sigma)
    score = score / jnp.maximum(score.max(), 1e-12)  # far from the middle all scores are low

    poses = _drawn_poses(model, config)
    field = distance_field(np.asarray(model.mesh.vertices), np.asarray(model.mesh.faces))
    reaches = _reach(robot, field, from_heatmap(heatmap, score, _CANDIDATES), poses)
    handed = reaches.outcome == ReachOutcome.HANDOFF
    reached, last = handed.any(axis=1), handed.argmax(axis=1)
    scene = build_scene([model], robot)
    success, closed = _close(scene, robot, _handoffs(robot, model, poses, reaches, reached, last))
    if config.shown >= success.sum():
        raise InputError(
            "--shown", config.shown, f"less than {success.sum()}, the poses lifted from"
        )
    row = int(np.flatnonzero(success)[config.shown])
    shown = int(np.flatnonzero(reached)[row])

    subjects = _subjects(
        jax.tree.map(np.asarray, heatmap),
        np.asarray(surface.faces),
        np.asarray(score),
        anchor,
        (reaches.position[shown, last[shown]] - poses.p_wo[shown]) @ poses.R_wo[shown],
    )
    reach = jax.tree.map(lambda leaf: leaf[shown, : last[shown] + 1], reaches)
    motion = _motion(scene, reach, poses, shown, closed[:, row])
    pictures, axes = _seen(record_world(scene, model.name, motion, 1.0), poses.R_wo[shown])
    drawn = [*(draw(subject, _PIXELS, _PIXELS, axes) for subject in subjects), *pictures]
    stages = [(name, said.format(instruction=config.instruction)) for name, said in STAGES]
    write_png(config.out, _sheet(drawn, stages), 1000 * config.max_kb)
    outcome = {"poses": config.poses, "shown": shown}
    outcome |= {"handed_off": int(reached.sum()), "lifted": int(success.sum())}
    grasp = {"object": config.object, "mesh": model.source, "instruction": config.instruction}
    grasp |= {"sigma_m": config.sigma, "anchor_m": anchor.tolist()}
    write_json(config.results, {"schema": SCHEMA, **grasp, **outcome, "provenance": made})
    print(f"{outcome}, written: {config.out}, {config.results}")


def _drawn_poses(model: ObjectModel, config: RouteConfig) -> Poses:
    rng = np.random.default_rng(config.seed)
    p_wo, quat = sample_object_poses(model.resting, config.poses, SamplingConfig(), rng)
    R_wo = so3.quat_to_mat(jnp.asarray(quat, jnp.float32))
    return Poses(np.float32(p_wo), np.float32(quat), np.asarray(R_wo))


def _reach(robot: RobotSpec, field: DistanceField, candidates: Candidates, poses: Poses) -> Reaches:
    """Reaches from home by the default controller, its commands integrated."""
    body, settings = robot_body(robot), reach_preset("default")
    assert settings.plan is not None
    selection = replace(settings.selection, min_score=_LEAST_SCORE)
    reacher = Reacher(body, settings.reach, selection)
    library = start_library(body, settings.plan)
    planner = Planner(reacher, settings.plan)
    dt = settings.reach.controller.dt

    @jax.jit
    def all_of(library, field, candidates, p_wo, R_wo, keys) -> Reaches:
        def one(situation) -> Reaches:
            p, R, key = situation
            around, q = Surroundings.still(field, p, R), jnp.asarray(body.home)
            plans = planner.search(library, candidates, around, q, key).plans

            def tick(carry, _):
                state, q = carry
                state, done = reacher.tick(
                    state, q, field, candidates, p, R, jnp.zeros((0, 4)), plans
                )
                away = jnp.linalg.norm(done.goals - done.tips, axis=-1).mean()
                seen = Reaches(
                    q, away, done.report.error, done.targets.position, done.targets.normal,
                    state.outcome,
                )  # fmt: skip
                return (state, q + dt * done.velocity), seen

            begun = reacher.start(q, candidates, p, R, plans), q
            return jax.lax.scan(tick, begun, length=_TICKS)[1]

        return jax.lax.map(one, (p_wo, R_wo, keys))

    keys = jax.random.split(jax.random.key(0), len(poses.p_wo))
    found = all_of(library, field, candidates, poses.p_wo, poses.R_wo, keys)
    return jax.tree.map(np.asarray, found)


def _handoffs(
    robot: RobotSpec,
    model: ObjectModel,
    poses: Poses,
    reaches: Reaches,
    reached: Bool[np.ndarray, " n"],
    last: Int[np.ndarray, " n"],
) -> HandoffSet:
    """The ends of the reaches as start states.

    Raises:
        InputError: No reach handed off.
    """
    if not reached.any():
        raise InputError("--seed", "poses that are not reached", "one at least that is")
    rows = np.flatnonzero(reached)
    end = jax.tree.map(lambda leaf: leaf[rows, last[rows]], reaches)
    return HandoffSet(
        object_index=np.zeros(len(rows), np.int32),
        object_pos=poses.p_wo[rows],
        object_quat=poses.quat[rows],
        q=end.q,
        target_pos=end.position,
        target_normal=end.normal,
        score=np.ones(len(rows), np.float32),
        residual=end.error,
        object_names=(model.name,),
        object_content_hash=(model.content_hash,),
        kind="reached",
        robot=robot.identity,
    )


def _close(
    scene: Scene, robot: RobotSpec, handoffs: HandoffSet
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "t n nq"]]:
    """Which start states the policy lifts the object from, and all positions on the way."""
    policy = load_controller(asset_path("policy.npz"), robot)
    config, count = policy_task(policy), len(handoffs)
    world = build_world(scene, handoffs, config.control_dt)
    task = world.task("mujoco", count, config, with_privileged=False)
    draw = paired_draws(world.starts, 0, count, StartNoise(offset_m=0.0), seed=0)
    draw = draw._replace(row=jnp.arange(count))
    trials, qpos = record_trials(task, lambda obs: policy(obs["state"]), draw)
    return np.asarray(trials.success), qpos


def _motion(
    scene: Scene, reach: Reaches, poses: Poses, shown: int, closed: Float[np.ndarray, "t nq"]
) -> Float[np.ndarray, "4 nq"]:
    """On the way, at the handoff, closed, lifted."""
    at = scene.addresses
    reaching = np.zeros((len(reach.q), scene.model.nq))
    reaching[:, at.robot_qpos] = reach.q
    reaching[:, at.object_qpos] = np.concatenate([poses.p_wo[shown], poses.quat[shown]])
    height = closed[:, at.object_qpos[2]]
    rising = int(np.argmax(height > height[0] + 0.01))
    near = int(np.argmax(reach.away < _AWAY_M))
    ticks = (
        reaching[near],
        reaching[-1],
        closed[max(rising - _BEFORE_LIFT, 0)],
        closed[np.argmax(height)],
    )
    return np.stack(ticks)


def _subjects(
    heatmap: Heatmap,
    faces: Int[np.ndarray, "f 3"],
    score: Float[np.ndarray, " v"],
    anchor: Float[np.ndarray, " 3"],
    points: Float[np.ndarray, "3 3"],
) -> list[Subject]:
    """The mesh, its heatmap, steered, with the three points."""
    vertices, normals = np.float64(heatmap.vertices), np.float64(heatmap.normals)

    def subject(score: Float[np.ndarray, " v"], **marks: Float[np.ndarray, "..."]) -> Subject:
        shown = np.where(heatmap.valid, score, np.nan)
        return Subject(vertices, faces, normals, shown, **marks)

    return [
        subject(np.full(len(vertices), np.nan)),
        subject(heatmap.score),
        subject(score, anchor=anchor),
        subject(score, thumb=np.float64(points[0]), wrap=np.float64(points[1:])),
    ]


def _seen(
    recording: Trajectory, R_wo: Float[np.ndarray, "3 3"]
) -> tuple[list[Picture], Float[np.ndarray, "3 3"]]:
    """Pictures of a motion, and the camera axes in the object frame that look from its side."""
    wide = frames.render(recording, round(_PIXELS / _CROP), round(_PIXELS / _CROP), 1.0)
    edge = (wide[0].shape[0] - _PIXELS) // 2
    pictures = [picture[edge : edge + _PIXELS, edge : edge + _PIXELS] for picture in wide]
    model = frames.load_model(recording)
    targets = look_at(model, recording.qpos, recording.focus, 1.0)
    azimuth = best_azimuth(model, recording.qpos[-1], recording.focus, targets[-1])
    return pictures, look_from(np.radians(azimuth - 0.5 * TURN_DEG + 180.0), _ELEVATION) @ R_wo


def _sheet(pictures: list[Picture], stages: list[tuple[str, str]]) -> Image.Image:
    """All pictures on a grid, in reading order, numbered, with arrows between."""
    rows = len(pictures) // _COLUMNS
    figure = Figure(figsize=(3.4 * _COLUMNS, 3.95 * rows), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.93, bottom=0.02, wspace=0.09, hspace=0.24)
    for k, (ax, picture) in enumerate(
        zip(figure.subplots(rows, _COLUMNS).flat, pictures, strict=True)
    ):
        ax.imshow(picture)
        ax.set_xticks([]), ax.set_yticks([])
        ax.spines[:].set_color("#d5d9e0")
        name, said = stages[k]
        ax.set_title(f"{k + 1}  {name}", loc="left", fontsize=15, weight="bold", color=_INK, pad=24)
        ax.text(0.0, 1.03, said, fontsize=11.5, color=_GREY, transform=ax.transAxes)
        if k % _COLUMNS:
            ax.annotate(
                "", (0.0, 0.5), (-0.09, 0.5), xycoords="axes fraction",
                arrowprops={"arrowstyle": "-|>", "color": _INK, "lw": 1.5},
            )  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(RouteConfig, description=__doc__)))
