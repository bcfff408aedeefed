"""Why some start states always fail: what their posture and contacts say beforehand.

Of trials from the training states (`evaluate_controllers.py --states training`), those that fail
with every controller are told apart by what is known before anything moves:

- lift: how far the palm ends from where a lift straight up should bring it (limits of the arm)
- reach: how far a finger's pad stays from its contact, the palm at rest (joint limits of a finger)
- force: the least force, in units of the weight, with which the contacts hold the object
- edge: how far the surface falls away within half a fingertip's width of a contact

each with the area under its ROC curve: the chance that a failing state has more of it than another.
The same is said of the evaluation states, from which nothing was chosen. The picture shows the
failing states as their trials begin, under their reason.

  MUJOCO_GL=egl python experiments/failing_starts.py --objects-dir SCANS
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from renderer import check_backend
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata
from small_png import write_png

from mjx_grasp.cli import run_command
from mjx_grasp.geometry.signed_distance import signed_distance
from mjx_grasp.grasp.wrench_margin import ContactConfig, Load, holding_force
from mjx_grasp.handoff.config import PostureConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, states_of
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.clearance import collision_field
from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.posture.touch import touch_errors
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.plan_costs import circles
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import Scene, SceneConfig
from mjx_grasp.tasks.assemble import build_scene_of

SCHEMA = "mjx_grasp.failing_starts/1"
_FAR, _SKY = 5.0, 235
"""Distance from which nothing is there [m], and how light that is drawn"""
FEATURES = ("lift", "reach", "force", "edge", "score")


@dataclass(frozen=True)
class FailingConfig(CommandSettings):
    """What to look at, and where to draw it."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    training: Path = Path("experiments/results/starts/training_native.json")
    """trials from the training states"""
    evaluation: Path = Path("experiments/results/eight_native.json")
    """trials from the evaluation states"""
    friction: Positive = 0.4
    """of the contacts in the least force: half of the scene's [-]"""
    columns: Count = 8
    cell_pixels: Count = 200
    max_kb: Count = 400
    """largest picture"""
    out: Path = Path("experiments/results/failing_starts.json")
    picture: Path = Path("docs/failing_starts.png")


def main(config: FailingConfig) -> None:
    """The command."""
    for flag, path in (("--out", config.out), ("--picture", config.picture)):
        check_writable(flag, path)
    check_backend()
    made = provenance(0)
    robot, names = load_robot(), resolve(("eight",))
    scene = build_scene_of(names, config.objects_dir, robot, SceneConfig())
    stored = load_handoffs(shipped_handoffs(config.objects_dir), scene.objects, robot)
    parts, picture = [], None
    for part, path in (("training", config.training), ("evaluation", config.evaluation)):
        states = states_of(stored, names, part)
        tried, fails = outcomes(path, len(states))
        features = features_of(states, scene, robot, config)
        parts.append(summary(part, path, tried, fails, features))
        if picture is None:
            picture = sheet(states, scene, fails, features, config)
            rows = reasons_of(states, fails, features)
    document = {
        "schema": SCHEMA,
        "provenance": made,
        "source": "parametric" if config.objects_dir is None else "scan",
        "lift_error_m": PostureConfig().lift_error,
        "reach_m": PostureConfig().touch_error,
        "friction": config.friction,
        "parts": parts,
        "rows": rows,
    }
    write_json(config.out, document)
    write_png(config.picture, picture, 1000 * config.max_kb)
    print(json.dumps(parts, indent=1))


def outcomes(path: Path, count: int) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Which states were tried, and which of them failed in every trial of every row."""
    tried, lifted = np.zeros(count, bool), np.zeros(count, bool)
    for row in json.loads(path.read_text())["rows"]:
        for start, outcome in zip(row["starts"], row["outcomes"], strict=True):
            tried[start] = True
            lifted[start] |= outcome == "S"
    return tried, tried & ~lifted


def features_of(
    states: HandoffSet, scene: Scene, robot: RobotSpec, config: FailingConfig
) -> dict[str, Float[np.ndarray, " n"]]:
    """What is known of each state beforehand: errors in [m], the force in weights."""
    body, height = robot_body(robot), PostureConfig().lift_height
    lift = jax.jit(jax.vmap(lambda q: scripted_lift(body, q, height).error))(states.q)
    touch = jax.jit(jax.vmap(lambda q, at: jnp.max(touch_errors(body, q, at))))
    turns = Rotation.from_quat(np.roll(states.object_quat, -1, axis=1)).as_matrix()
    com = np.stack([o.com for o in scene.objects])[states.object_index]
    point = states.object_pos + np.einsum("nij,nj->ni", turns, com)
    contact = ContactConfig(friction=config.friction)

    def force(position: jax.Array, normal: jax.Array, com: jax.Array) -> jax.Array:
        return holding_force(position, -normal, Load(np.float32([0, 0, -1]), com), contact)

    forces = jax.jit(jax.vmap(force))(states.target_pos, states.target_normal, np.float32(point))
    edges = np.zeros(len(states))
    circle = np.asarray(circles(states.target_pos, states.target_normal, PlanConfig().edge_radius))
    for k, obj in enumerate(scene.objects):
        own = states.object_index == k
        around = circle[own].reshape(own.sum(), -1, 3) - states.object_pos[own][:, None]
        local = np.einsum("nji,npj->npi", turns[own], around)
        field = collision_field(obj)
        edges[own] = np.max(signed_distance(field, jnp.asarray(local, jnp.float32)), axis=1)
    return {
        "lift": np.asarray(lift),
        "reach": np.asarray(touch(states.q, states.target_pos)),
        "force": np.asarray(forces),
        "edge": edges,
        "score": -states.score,
    }


def summary(
    part: str,
    path: Path,
    tried: Bool[np.ndarray, " n"],
    fails: Bool[np.ndarray, " n"],
    features: dict[str, Float[np.ndarray, " n"]],
) -> dict[str, Any]:
    """Areas under the curve, of all states and of those from which the arm can lift."""
    liftable = features["lift"] <= PostureConfig().lift_error
    both = liftable & (features["reach"] <= PostureConfig().touch_error)
    return {
        "part": part,
        "trials": path.as_posix(),
        "states": int(tried.sum()),
        "failing": int(fails.sum()),
        "auc": {name: _auc(features[name][tried], fails[tried]) for name in FEATURES},
        "auc_where_the_arm_lifts": {
            name: _auc(features[name][tried & liftable], fails[tried & liftable])
            for name in FEATURES
        },
        "left_by": {
            name: {"states": int((tried & kept).sum()), "failing": int((fails & kept).sum())}
            for name, kept in (("lift", liftable), ("lift and reach", both))
        },
    }


def _auc(values: Float[np.ndarray, " n"], fails: Bool[np.ndarray, " n"]) -> float | None:
    """Chance that a failing state has more than another; None where there are not both."""
    few, many = int(fails.sum()), int((~fails).sum())
    if not few or not many:
        return None
    ranks = rankdata(np.nan_to_num(values, posinf=1e9))
    return float((ranks[fails].sum() - few * (few + 1) / 2) / (few * many))


def reasons_of(
    states: HandoffSet,
    fails: Bool[np.ndarray, " n"],
    features: dict[str, Float[np.ndarray, " n"]],
) -> list[dict[str, Any]]:
    """The failing states, each with what is wrong with it."""
    return [
        {
            "state": int(n),
            "object": states.object_names[states.object_index[n]],
            "reason": _reason(features, n),
            "lift_error_mm": 1e3 * float(features["lift"][n]),
            "reach_error_mm": 1e3 * float(features["reach"][n]),
            "force_per_weight": float(features["force"][n]),
            "edge_mm": 1e3 * float(features["edge"][n]),
            "score": float(states.score[n]),
        }
        for n in np.flatnonzero(fails)
    ]


def _reason(features: dict[str, Float[np.ndarray, " n"]], n: int) -> str:
    if features["lift"][n] > PostureConfig().lift_error:
        return "arm cannot lift"
    return (
        "finger cannot reach"
        if features["reach"][n] > PostureConfig().touch_error
        else "contacts slip"
    )


def sheet(
    states: HandoffSet,
    scene: Scene,
    fails: Bool[np.ndarray, " n"],
    features: dict[str, Float[np.ndarray, " n"]],
    config: FailingConfig,
) -> Image.Image:
    """The failing states, by reason."""
    chosen = sorted(np.flatnonzero(fails), key=lambda n: _reason(features, n))
    side, caption = config.cell_pixels, 30
    rows = -(-len(chosen) // config.columns)
    picture = Image.new("RGB", (config.columns * side, rows * (side + caption)), "white")
    draw = ImageDraw.Draw(picture)
    scene.model.vis.headlight.ambient[:], scene.model.vis.headlight.diffuse[:] = 0.4, 0.6
    with mujoco.Renderer(scene.model, side, side) as renderer:
        for k, n in enumerate(chosen):
            corner = (k % config.columns) * side, (k // config.columns) * (side + caption)
            shown = Image.fromarray(_render(renderer, states, scene, n))
            picture.paste(shown, (corner[0], corner[1] + caption))
            name = states.object_names[states.object_index[n]].replace("_", " ")
            errors = f"{1e3 * features['lift'][n]:.0f}, {1e3 * features['reach'][n]:.0f} mm"
            draw.text((corner[0] + 3, corner[1] + 2), f"{n} {name}", "black")
            text = f"{_reason(features, n)} ({errors})"
            draw.text((corner[0] + 3, corner[1] + 15), text, "black")
    return picture


def _render(
    renderer: mujoco.Renderer, states: HandoffSet, scene: Scene, n: int
) -> UInt8[np.ndarray, "h w 3"]:
    model, data, at = scene.model, mujoco.MjData(scene.model), scene.addresses
    model.geom_pos[:] = scene.object_fields.geom_pos[states.object_index[n]]
    data.qpos[at.robot_qpos] = states.q[n]
    data.qpos[at.object_qpos] = np.concatenate([states.object_pos[n], states.object_quat[n]])
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation = 0.65, -20.0
    # Along the wraps, so that they are seen apart from the thumb, and with the arm behind them.
    spread = states.target_pos[n, 1] - states.target_pos[n, 2]
    spread = spread if spread[0] < 0 else -spread
    camera.azimuth = float(np.degrees(np.arctan2(spread[1], spread[0])))
    camera.lookat[:] = states.object_pos[n]
    renderer.update_scene(data, camera)
    picture = renderer.render().copy()
    renderer.enable_depth_rendering()
    picture[renderer.render() > _FAR] = _SKY
    renderer.disable_depth_rendering()
    return picture


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(FailingConfig, description=__doc__)))
