"""The settings of a training run, its presets, and how they are kept with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mjx_grasp.closing.config import REACTING, ActionConfig, GripConfig, LiftConfig
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.handoff.config import HandoffGate, HandoffKind
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.devices import RunOn
from mjx_grasp.learning.run import LoopConfig
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.settings import (
    Count,
    Seed,
    WholeNumber,
    from_record,
)
from mjx_grasp.sim.engines import Engine
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, has_gpu
from mjx_grasp.tasks.config import EndToEndConfig, RewardConfig, RobotErrors, StartNoise
from mjx_grasp.tasks.record import task_from_record

Preset = Literal["auto", "cpu", "gpu", "paper", "end-to-end"]


@dataclass(frozen=True)
class TrainConfig(ObjectsConfig):
    """A training run."""

    preset: Preset = "auto"
    """cpu, gpu, paper, end-to-end; auto takes gpu where JAX finds one and cpu otherwise. What this
    help shows as the other settings' defaults is what the preset sets. cpu and gpu train a policy
    that feels forces and is given a budget of them, on a grip that answers to load, gpu from
    nothing and cpu from the shipped policy; paper has the published observation, command, actions,
    critic and number of worlds and steps; end-to-end is the publication's baseline of one policy
    that reaches, closes and lifts."""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    handoffs: Path | None = None
    """handoff set; if none is given, one that ships with the package where it has these objects and
    is of this kind, as in the presets cpu and gpu, else it is made first"""
    handoffs_per_object: Count = 64
    """states per object when they are made first; a shipped set has as many, or is not taken [-]"""
    handoffs_kind: HandoffKind = "ik"
    """what kind they are then; reached ones take minutes for each object"""
    handoffs_gate: HandoffGate = "default"
    """when a reach hands off, for reached ones"""
    out: Path | None = None
    """folder of the run; runs/<preset>-<time> by default"""
    resume: Path | None = None
    """folder of a run to continue; its own configuration is used"""
    start_from: str | None = None
    """policy with which the training begins, of the same robot, observations, actions and layers: a
    file, or `shipped`; None: it begins with nothing"""
    engine: Engine = "mjx"
    """what steps the physics: mjx (Warp, GPU or CPU) or mujoco (native, in threads)"""
    seed: Seed = 0
    """of parameters, exploration and start states that are made; on a GPU a run does not quite
    repeat itself"""
    fit_memory: bool = False
    """take fewer worlds than --ppo.worlds where the device's memory does not hold them; off where
    that is given"""
    evaluation_episodes: WholeNumber = 64
    """episodes per object after training, of the policy and what it is compared with; 0 for none"""
    run_on: Annotated[RunOn, tyro.conf.arg(name="")] = field(default_factory=RunOn)
    scene: SceneConfig = field(default_factory=SceneConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    noise: StartNoise = field(default_factory=StartNoise)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.handoffs_kind == "ik" and self.handoffs_gate != "default":
            expected = "default, or --handoffs-kind reached or mixed"
            raise InputError(self.name_of("handoffs_gate"), self.handoffs_gate, expected)


FEELING = TaskConfig(
    action=ActionConfig(grip_range=3.0, arm_settles=True),
    grip=replace(REACTING, force=1.5),
    observation=ObservationConfig(forces=True, budget=True),
    reward=RewardConfig(held=4.0, over_budget=-5.0, spent=-1.0, hard=-0.2),
)
"""A policy that senses forces and keeps to a budget of them: it moves the fingers of a grip that
answers to load, and scales its force."""
VARIED = StartNoise(
    offset_m=0.01,
    angle_rad=math.radians(5.0),
    friction=(0.4, 1.0),
    mass_scale=(0.8, 1.25),
    budget_n=(1.0, 12.0),
    robot=RobotErrors(stiffness=(0.5, 2.0)),
)
"""What its training draws anew at each reset."""


def preset_config(preset: str) -> TrainConfig:
    """The configuration behind a preset's name.

    Raises:
        InputError: An unknown preset, or one that needs a GPU where there is none.
    """
    if preset == "auto":
        preset = "gpu" if has_gpu() else "cpu"
    if preset == "gpu" and not has_gpu():
        raise InputError("--preset", "gpu (JAX finds no GPU here)", "a GPU, or --preset cpu")
    return settings_of(preset)


def settings_of(preset: str) -> TrainConfig:
    """The same for a preset by name, whether or not this machine could train with it.

    Raises:
        InputError: An unknown preset.
    """
    if preset == "cpu":
        return TrainConfig(
            preset="cpu",
            scene=SceneConfig(fix_idle_fingers=True, physics_dt=0.005),
            # The shipped policy lifts nearly all of it: what is left to win is a softer grasp.
            task=replace(FEELING, reward=replace(FEELING.reward, hard=-1.0)),
            noise=VARIED,
            objects=("rubiks_cube",),
            # Like those that the shipped policy was trained from.
            handoffs_kind="reached",
            handoffs_per_object=256,
            # From nothing, the steps that two cores make in minutes are too few.
            start_from="shipped",
            engine="mujoco",
            ppo=PPOConfig(
                worlds=128,
                unroll=128,
                iterations=50,
                critic_first=0.15,
                averaged=0.4,
                learning_rate=3e-4,
                action_std=0.12,
                critic_rate=3e-4,
                value_clip=0.5,
            ),
        )
    if preset == "gpu":
        return TrainConfig(
            preset="gpu",
            fit_memory=True,
            # Where reaching comes to, as in a whole grasp: the shipped sets have such ones.
            handoffs_kind="reached",
            handoffs_per_object=128,
            scene=SceneConfig(fix_idle_fingers=True, physics_dt=0.005),
            task=FEELING,
            noise=VARIED,
            ppo=PPOConfig(
                worlds=8192,
                iterations=235,
                averaged=0.3,
                action_std=0.15,
                critic_rate=3e-4,
                value_clip=0.5,
            ),
        )
    if preset == "paper":
        return TrainConfig(
            preset="paper",
            engine="mjx" if has_gpu() else "mujoco",
            objects=("train",),
            handoffs_per_object=42,
            handoffs_kind="reached",
            handoffs_gate="paper",
            task=TaskConfig(
                action=ActionConfig(residual="integrated"),
                lift=LiftConfig(delay_s=0.0),
                grip=GripConfig(together=False, arrival=0.0, approach_s=None, freezes=False),
                reward=RewardConfig(lift_speed=0.15),
            ),
            ppo=PPOConfig(
                worlds=1024, unroll=64, iterations=470, tuning=10, privileged_critic=False
            ),
        )
    if preset == "end-to-end":
        paper = settings_of("paper")
        own = paper.task
        task = EndToEndConfig(
            action=replace(own.action, arm_rate=EndToEndConfig().action.arm_rate),
            lift=own.lift,
            grip=own.grip,
            reward=own.reward,
        )
        return replace(paper, preset="end-to-end", task=task)
    raise InputError("--preset", preset, "auto, cpu, gpu, paper or end-to-end")


def from_stored(record: dict[str, Any]) -> TrainConfig:
    """The settings of a run of today or before.

    Raises:
        InputError: A field is unknown or its value is not allowed.
    """
    others = {name: value for name, value in record.items() if name != "task"}
    config = from_record(TrainConfig, others, "config")
    return replace(config, task=task_from_record(record["task"])) if "task" in record else config


def stored_config(folder: Path) -> TrainConfig:
    """The configuration of a run, set to be resumed.

    Raises:
        FileError: There is no readable configuration, or one with unknown or impossible settings.
    """
    path = folder / "config.json"
    if not path.exists():
        raise FileError(folder, "no run: config.json is missing", "a run's folder")
    expected = "the settings of a run"
    try:
        return replace(from_stored(read_json(path, expected)), resume=folder)
    except InputError as error:
        raise FileError(path, str(error), expected) from None
