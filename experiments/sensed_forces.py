"""How well the fingers' forces and contacts are felt, over whole grasps in native MuJoCo.

The estimate of each finger's force from its joint torques is held against the solver's, and the
observer's contact flags against the solver's contacts: with perfect torques, and with noise,
quantisation and a wrong model of joint friction. Nothing is left out but, for the flags, the ticks
after the object is lost. A contact is a force of the object on the finger, wherever it touches.

The flags' thresholds are swept on the training states of training objects: of all settings that
reach the asked precision there the one of most recall is chosen, under the worst errors.

  python experiments/sensed_forces.py --objects-dir SCANS
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float
from rich.console import Console
from sensing import first_onsets, flag_score, force_errors, onset_record, phase_masks, spread
from sensing_figure import draw_grasp
from sensing_tables import SHORT, flags_table, forces_table

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING, ForceConfig, GripConfig, ObserverConfig
from mjx_grasp.closing.control import pad_jacobians
from mjx_grasp.closing.forces import tip_forces
from mjx_grasp.closing.observer import initial_observer, observe
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.trials import Trials, paired_draws, watch_trials, zero_controller
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.objects.catalogue import load_catalogue, resolve
from mjx_grasp.records.atomic import check_writable, replacing, write_json
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import (
    CommandSettings,
    Count,
    NonNegative,
    Positive,
    Seed,
    Share,
    to_record,
)
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import World, build_scene_of, build_world
from mjx_grasp.tasks.closing import ClosingState, ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, RobotErrors, StartNoise

SCHEMA = "mjx_grasp.sensed_forces/1"
ROOT = Path(__file__).resolve().parent.parent
CONTROLLERS = {"grip": REACTING, "squeeze 5 N": GripConfig(force=5.0)}
Part = Literal["report", "calibration"]


@dataclass(frozen=True)
class SensingConfig(CommandSettings):
    """What to report, with which errors, and what to calibrate on."""

    out: Path = ROOT / "experiments" / "results" / "sensed_forces.json"
    figure: Path | None = ROOT / "docs" / "sensed_forces.png"
    """picture of one grasp and of all forces; none with None"""
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    episodes: Count = 64
    """trials of each object, from states kept out of training"""
    seed: Seed = 1
    torque_std: NonNegative = 0.02
    """noise of each reading of a joint's torque, in the conditions with noise [N m]"""
    torque_step: NonNegative = 0.01
    """quantisation of these readings, in the conditions with it [N m]"""
    friction_error: Share = 0.3
    """by which the model of joint friction is wrong, in the conditions with that"""
    contact_n: Positive = 0.1
    """force that is a contact [N]"""
    crossing_n: Positive = 0.5
    """force at whose crossing the estimate's delay is measured [N]"""
    lasting_ticks: Count = 5
    """control ticks for which a contact must last to have an onset"""
    calibration_objects: tuple[str, ...] = ("train",)
    calibration_episodes: Count = 16
    """trials of each training object, from its training states"""
    precision: Share = 0.99
    """that the chosen thresholds have to reach"""
    contact_torques: tuple[Positive, ...] = (0.005, 0.01, 0.02, 0.03, 0.05, 0.08)
    """thresholds to sweep [N m]"""
    stall_speeds: tuple[Positive, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    """speeds to sweep [rad/s]"""
    drawn_object: str | None = None
    """whose first successful grasp is drawn; the first object's by default"""
    parts: tuple[Part, ...] = field(default=("report", "calibration"))


class Condition(NamedTuple):
    """A robot that feels, and what it takes its friction for."""

    name: str
    errors: RobotErrors = RobotErrors()
    friction: float = 0.0
    """error of the model of joint friction, as a share [-]"""
    forces: ForceConfig = ForceConfig(sticking=0.02)


class Seen(NamedTuple):
    """Of every tick and trial, fingers last but for vectors."""

    estimated: Float[np.ndarray, "t w f 3"]
    """force of the object on the finger, by the estimator [N]"""
    within_reach: Float[np.ndarray, "t w f 3"]
    """what the estimator would make of exact torques of the true force at the pad [N]"""
    true: Float[np.ndarray, "t w f 3"]
    """by the solver [N]"""
    flag: Bool[np.ndarray, "t w f"]
    gripping: Bool[np.ndarray, "t w f"]
    rising: Bool[np.ndarray, "t w"]
    torque: Float[np.ndarray, "t w s g"]
    """external torque as sensed [N m]"""
    q: Float[np.ndarray, "t w g"]
    qd: Float[np.ndarray, "t w g"]


def conditions_of(config: SensingConfig) -> list[Condition]:
    """The robots to try, the worst last."""
    wrong = config.friction_error
    noise = RobotErrors(torque_std=config.torque_std)
    step = RobotErrors(torque_step=config.torque_step)
    friction = RobotErrors(friction=wrong)
    everything = replace(friction, torque_std=config.torque_std, torque_step=config.torque_step)
    percent = f"{100 * wrong:g} %"
    return [
        Condition("exact torques"),
        Condition("no model of friction", forces=ForceConfig()),
        Condition(f"noise {config.torque_std:g} N m", noise),
        Condition(f"steps of {config.torque_step:g} N m", step),
        Condition(f"friction +{percent}", friction, wrong),
        Condition(f"friction −{percent}", friction, -wrong),
        Condition(f"all, friction +{percent}", everything, wrong),
        Condition(f"all, friction −{percent}", everything, -wrong),
    ]


def main(config: SensingConfig) -> None:
    """Runs the parts that are asked for, and writes the file."""
    if not config.parts:
        raise InputError("--parts", "none", "report, calibration or both")
    names = resolve(config.objects)
    if config.drawn_object is not None and config.drawn_object not in names:
        raise InputError("--drawn-object", config.drawn_object, f"one of {', '.join(names)}")
    tuned_on = resolve(config.calibration_objects)
    untouched = [n for n in tuned_on if load_catalogue()[n].split == "held_out"]
    if untouched:
        raise InputError("--calibration-objects", untouched, "no object that is held out")
    check_writable("--out", config.out)
    if config.figure:
        check_writable("--figure", config.figure)
    console, robot = Console(stderr=True), load_robot()
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    stored, made = load_handoffs(handoffs, robot=robot), provenance(config.seed)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "settings": to_record(config),
        "sha256": file_digests(handoffs=handoffs),
    }
    if "report" in config.parts:
        world, tried = _world(names, stored, "evaluation", config, robot)
        content |= {"objects": tried, "rows": _report(world, tried, config, robot, console)}
        Console().print(forces_table(content["rows"]), flags_table(content["rows"]))
        write_json(config.out, content | {"provenance": made})  # the calibration takes its time
    if "calibration" in config.parts:
        world, tried = _world(tuned_on, stored, "training", config, robot)
        content["calibration"] = {"objects": tried} | _calibration(world, tried, config, console)
    write_json(config.out, content | {"provenance": made})
    print(f"written: {config.out}")


def chosen(rows: Sequence[dict[str, Any]], precision: float) -> dict[str, Any] | None:
    """Of the rows that reach the precision the one of most recall; None if none does."""
    good = [r for r in rows if (r["precision"] or 0.0) >= precision]
    return max(good, key=lambda r: r["recall"] or 0.0, default=None)


def summary(
    seen: Seen, trials: Trials, fingers: Sequence[str], dt: float, config: SensingConfig
) -> dict[str, Any]:
    """All figures of one controller under one condition.

    Args:
        seen: The trials, tick by tick.
        trials: What came of them.
        fingers: Names of the fingers.
        dt: Control period [s].
        config: What counts as contact.
    """
    size = np.linalg.norm(seen.true, axis=-1)
    contact = size > config.contact_n
    untouched, kept = _before_and_until_lost(size > 0)
    felt = np.linalg.norm(seen.estimated, axis=-1)
    rows = {}
    for f, name in enumerate(fingers):
        estimated, true, touch = seen.estimated[:, :, f], seen.true[:, :, f], contact[:, :, f]
        phases = phase_masks(seen.gripping[:, :, f], seen.rising)
        beyond = np.linalg.norm(seen.within_reach[:, :, f] - true, axis=-1)
        alone = (size[:, :, f] == 0) & ~untouched
        crossed = first_onsets(
            felt[:, :, f] > config.crossing_n,
            size[:, :, f] > config.crossing_n,
            config.lasting_ticks,
        )
        flag = seen.flag[:, :, f]
        rows[name] = {
            "contact": force_errors(estimated, true, touch)
            | {"out_of_reach_n": spread(beyond[touch])},
            "phases": {
                phase: force_errors(estimated, true, touch & mask) for phase, mask in phases.items()
            },
            "free_motion_n": spread(felt[:, :, f][untouched]),
            "free_while_others_touch_n": spread(felt[:, :, f][alone & kept]),
            "after_loss_n": spread(felt[:, :, f][~kept]),
            "crossing": onset_record(crossed, dt),
            "flag": flag_score(flag, touch, kept)
            | onset_record(first_onsets(flag, touch, config.lasting_ticks), dt)
            | {"false_before_any_contact": int((flag & untouched).sum())},
        }
    return {
        "trials": len(trials.success),
        "successes": int(trials.success.sum()),
        "ticks_after_loss": float(1.0 - kept.mean()),
        "fingers": rows,
    }


def _before_and_until_lost(
    touching: Bool[np.ndarray, "t w f"],
) -> tuple[Bool[np.ndarray, "t w"], Bool[np.ndarray, "t w"]]:
    """The ticks before any finger touches, and those up to the last in which one does."""
    anyone = touching.any(axis=-1)
    before = ~np.maximum.accumulate(anyone, axis=0)
    kept = np.maximum.accumulate(anyone[::-1], axis=0)[::-1]
    return before, kept | before


def _world(
    names: Sequence[str],
    stored: HandoffSet,
    part: str,
    config: SensingConfig,
    robot: RobotSpec,
) -> tuple[World, list[str]]:
    states = states_of(stored, [n for n in names if n in stored.object_names], part)
    found, _ = eligible(names, states)
    if not found:
        raise InputError("objects", list(names), f"some of {', '.join(stored.object_names)}")
    scene = build_scene_of(found, config.objects_dir, robot, SceneConfig())
    return build_world(scene, states.select(found), ClosingTaskConfig().control_dt), found


def _run(
    world: World,
    names: Sequence[str],
    grip: GripConfig,
    condition: Condition,
    episodes: int,
    seed: int,
) -> tuple[ClosingTask, Trials, Seen]:
    """The trials of all objects under one condition; starts are the same under each."""
    noise = StartNoise(robot=condition.errors)
    index = [world.scene.object_index(name) for name in names]
    draw = paired_draws(world.starts, index, episodes, noise, seed)
    count = len(draw.row)
    draw = draw._replace(robot=draw.robot._replace(friction=jnp.full(count, condition.friction)))
    settings = ClosingTaskConfig(grip=grip, forces=condition.forces)
    task = world.task("mujoco", count, settings, noise, with_privileged=False)
    assert isinstance(task, ClosingTask)
    at, closer = task.closer.joints.at, task.closer

    def look(state: ClosingState) -> Seen:
        measured, true = state.measured, -state.truth.finger_force  # the sensor's is the reaction
        jacobian = pad_jacobians(measured, at.grasping_per_finger)
        exact = jnp.sum(jacobian[..., :3, :] * true[..., None], axis=-2)
        free = closer.away_from_stops(measured)
        return Seen(
            estimated=closer.forces(state.closer, measured),
            within_reach=tip_forces(exact, jacobian, free, condition.forces),
            true=true,
            flag=state.closer.observed,
            gripping=state.closer.grip_ticks > 0,
            rising=state.closer.lifting & (closer.lift_speed(state.closer) > 0),
            torque=measured.external_torque,
            q=measured.q[:, at.grasping],
            qd=measured.qd[:, at.grasping],
        )

    return task, *watch_trials(task, zero_controller(task), draw, look)


def _runs(conditions: Sequence[Condition]) -> list[tuple[str, Condition]]:
    """The grip under every condition, the others with the best and the worst torques."""
    first, *others = CONTROLLERS
    ends = [conditions[k] for k in SHORT]
    return [(first, c) for c in conditions] + [(name, c) for name in others for c in ends]


def _report(
    world: World,
    names: Sequence[str],
    config: SensingConfig,
    robot: RobotSpec,
    console: Console,
) -> list[dict[str, Any]]:
    fingers = [finger.name for finger in robot.hand.fingers]
    runs, rows = _runs(conditions_of(config)), []
    with counting_progress(console) as bar:
        job = bar.add_task("grasps", total=len(runs))
        for controller, condition in runs:
            grip = CONTROLLERS[controller]
            task, trials, seen = _run(world, names, grip, condition, config.episodes, config.seed)
            if config.figure and not rows:
                _draw(config.figure, seen, trials, names, fingers, config)
            measured = summary(seen, trials, fingers, task.control_dt, config)
            rows.append({"controller": controller, "condition": condition.name} | measured)
            bar.update(job, advance=1)
    return rows


def _draw(
    path: Path,
    seen: Seen,
    trials: Trials,
    names: Sequence[str],
    fingers: Sequence[str],
    config: SensingConfig,
) -> None:
    first = config.episodes * list(names).index(config.drawn_object or names[0])
    which = first + int(np.argmax(trials.success[first : first + config.episodes]))
    picture = draw_grasp(
        np.linalg.norm(seen.true, axis=-1),
        np.linalg.norm(seen.estimated, axis=-1),
        seen.flag,
        which,
        fingers,
        ClosingTaskConfig().control_dt,
    )
    with replacing(path) as temporary:
        temporary.write_bytes(picture)


def _calibration(
    world: World, names: Sequence[str], config: SensingConfig, console: Console
) -> dict[str, Any]:
    """The sweep of the flags' thresholds, in runs whose own flags are those of the defaults."""
    now, conditions = ObserverConfig(), conditions_of(config)
    settings = [
        replace(now, contact_torque=torque, stall_speed=speed)
        for torque in sorted({*config.contact_torques, now.contact_torque})
        for speed in sorted({*config.stall_speeds, now.stall_speed})
    ]
    tried = [conditions[k] for k in SHORT]
    rows = []
    with counting_progress(console) as bar:
        job = bar.add_task("thresholds", total=len(tried) * len(settings))
        for condition in tried:
            task, _, seen = _run(
                world, names, REACTING, condition, config.calibration_episodes, config.seed
            )
            size = np.linalg.norm(seen.true, axis=-1)
            contact = size > config.contact_n
            untouched, kept = _before_and_until_lost(size > 0)
            series = contact.reshape(len(contact), -1)
            counted = np.broadcast_to(kept[..., None], contact.shape).reshape(series.shape)
            for observer in settings:
                flag = np.asarray(_flags(task, seen, observer))
                flat = flag.reshape(series.shape)
                onsets = first_onsets(flat, series, config.lasting_ticks)
                rows.append(
                    {
                        "condition": condition.name,
                        "contact_torque": observer.contact_torque,
                        "stall_speed": observer.stall_speed,
                    }
                    | flag_score(flat, series, counted)
                    | onset_record(onsets, task.control_dt)
                    | {"false_before_any_contact": int((flag & untouched[..., None]).sum())}
                )
                bar.update(job, advance=1)
    worst = [
        {k: one[k] for k in ("contact_torque", "stall_speed")}
        | {k: min(r[k] or 0.0 for r in (one, *others)) for k in ("precision", "recall")}
        for one, *others in zip(
            *([r for r in rows if r["condition"] == c.name] for c in tried), strict=True
        )
    ]
    return {
        "default": {k: getattr(now, k) for k in ("contact_torque", "stall_speed")},
        "chosen": chosen(worst, config.precision),
        "worst": worst,
        "rows": rows,
    }


def _flags(task: ClosingTask, seen: Seen, config: ObserverConfig) -> Bool[Array, "t w f"]:
    """The flags that an observer of other thresholds raises on what was sensed."""
    joints, (worlds, fingers) = task.closer.joints, seen.flag.shape[1:]
    limits = joints.limits[joints.at.grasping]

    def tick(state: Any, now: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        return observe(state, *now, limits, joints.dry_friction, task.control_dt, config)

    begun = initial_observer((worlds,), seen.q.shape[-1], fingers)
    return jax.jit(lambda x: jax.lax.scan(tick, begun, x)[1])((seen.torque, seen.q, seen.qd))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(SensingConfig, description=__doc__)))
