"""`python -m mjx_grasp.train`: from objects to a trained policy, its evaluation and a report.

Picks its preset from the hardware: `gpu` trains on the eight objects in MJX, `cpu` on one object
in native MuJoCo within minutes; `paper` is the published setting.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from mjx_grasp.after_training import evaluate_and_report
from mjx_grasp.atomic import check_writable, replacing
from mjx_grasp.cli import run_command
from mjx_grasp.closing.assemble import Engine, World, build_scene_of, build_world, has_gpu
from mjx_grasp.closing.config import ClosingConfig, StartNoise
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluate import eligible, states_of
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.learning.brax_env import BraxClosingEnv
from mjx_grasp.learning.checkpoint import newest_checkpoint, restore_checkpoint
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.log import require_wandb
from mjx_grasp.learning.memory import device_memory, worlds_that_fit
from mjx_grasp.learning.policy import policy_from_training
from mjx_grasp.learning.ppo import TrainState, init_state
from mjx_grasp.learning.run import LoopConfig, train_loop
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.provenance import provenance
from mjx_grasp.sim.scene import Scene, SceneConfig

_OPENING = ("config.json", "provenance.json")
"""Files that are written when a run is opened."""

Preset = Literal["auto", "cpu", "gpu", "paper"]


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    preset: Preset = "auto"
    """cpu, gpu, paper; auto takes gpu where JAX finds one and cpu otherwise. What this help shows
    as the other settings' defaults is what the preset sets."""
    objects: tuple[str, ...] = ("eight",)
    """Objects or groups of the catalogue to train on."""
    objects_dir: Path | None = None
    """Folder of real scans; parametric stand-ins without one."""
    handoffs: Path | None = None
    """Handoff set; made for the objects first if none is given."""
    handoffs_per_object: int = 64
    """States per object when they are made first."""
    out: Path | None = None
    """Folder of the run; runs/<preset>-<time> by default."""
    resume: Path | None = None
    """Folder of a run to continue; its own configuration is used."""
    engine: Engine = "mjx"
    seed: int = 0
    fit_memory: bool = False
    """Take as many worlds as the device's memory holds instead of ppo.worlds."""
    evaluation_episodes: int = 64
    """Episodes per object after training, for policy, untrained policy and squeeze; 0 for none."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    task: ClosingConfig = field(default_factory=ClosingConfig)
    noise: StartNoise = field(default_factory=StartNoise)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)

    def __post_init__(self):
        if self.evaluation_episodes < 0:
            raise InputError("--evaluation-episodes", self.evaluation_episodes, "0 or more")


def preset_config(preset: Preset) -> TrainConfig:
    """The configuration behind a preset's name.

    Raises:
        InputError: An unknown preset, or one that needs a GPU where there is none.
    """
    if preset == "auto":
        preset = "gpu" if has_gpu() else "cpu"
    if preset == "gpu" and not has_gpu():
        raise InputError("--preset", "gpu (JAX finds no GPU here)", "a GPU, or --preset cpu")
    if preset == "cpu":
        return TrainConfig(
            preset="cpu",
            scene=SceneConfig(fix_idle_fingers=True),
            objects=("rubiks_cube",),
            handoffs_per_object=192,
            engine="mujoco",
            ppo=PPOConfig(worlds=128, unroll=32, iterations=360),
        )
    if preset == "gpu":
        return TrainConfig(
            preset="gpu",
            fit_memory=True,
            scene=SceneConfig(fix_idle_fingers=True),
            ppo=PPOConfig(unroll=16, iterations=240),
        )
    if preset == "paper":
        return TrainConfig(
            preset="paper",
            engine="mjx" if has_gpu() else "mujoco",
            task=ClosingConfig(residual="integrated", lift_delay_s=0.0, grip_together=False),
            ppo=PPOConfig(worlds=1024, unroll=64, iterations=470, privileged_critic=False),
        )
    raise InputError("--preset", preset, "auto, cpu, gpu or paper")


def train(config: TrainConfig, console: Console) -> Path:
    """Runs a training to its end and returns the run's folder.

    Raises:
        InputError, FileError: A setting or file that cannot work; no folder is made then.
        KeyboardInterrupt: Ctrl-C; its message says how to continue, once there is a run.
    """
    require_wandb(config.loop.wandb_project)
    resumed = newest_checkpoint(config.resume / "checkpoints") if config.resume else None
    stored = None if config.handoffs is None else load_handoffs(config.handoffs)
    if stored is not None:
        _trainable(resolve(config.objects), stored)
    scene = build_scene_of(config.objects, config.objects_dir, config.scene)
    config = replace(config, ppo=_fit_worlds(config, scene), fit_memory=False)
    world = None if stored is None else _build(scene, stored, config, console)
    folder = _open_run(config)
    try:
        if stored is None or world is None:
            try:
                stored = _made_handoffs(config, folder, console)
            except MjxGraspError:
                if config.resume is None:
                    _discard_run(folder)
                raise
            world = _build(scene, stored, config, console)
        _run(folder, resumed, config, world, stored, console)
    except KeyboardInterrupt as interrupt:
        said = str(interrupt) or "interrupted"
        again = f"python -m mjx_grasp.train --resume {shlex.quote(str(folder))}"
        raise KeyboardInterrupt(f"{said}; continue with: {again}") from None
    return folder


def _run(
    folder: Path,
    resumed: Path | None,
    config: TrainConfig,
    world: World,
    handoffs: HandoffSet,
    console: Console,
) -> None:
    """Trains in an opened run, keeps the policy and evaluates it."""
    ppo = config.ppo
    names, _ = eligible(world.scene.object_names, handoffs)
    env = BraxClosingEnv(
        world.env(config.engine, ppo.worlds, config.task, config.noise, ppo.privileged_critic),
        ppo.worlds,
        ppo.stagger,
    )
    console.print(
        f"preset {config.preset}: {len(names)} object(s), {ppo.worlds} worlds in {config.engine}, "
        f"{ppo.iterations} iterations of {ppo.steps_per_iteration:,} steps → {folder}"
    )
    state = init_state(ppo, env, config.seed)
    if resumed is not None:
        state = restore_checkpoint(resumed, state, env)
        console.print(f"resumed from {resumed.name}")
    state = train_loop(folder, state, env, ppo, config.loop, to_json(config))
    _save_policy(folder, state, config, names, ppo)
    if config.evaluation_episodes:
        held_out = states_of(handoffs, names, "evaluation")
        evaluate_and_report(folder, config, world, held_out, console)


def _trainable(names: Sequence[str], handoffs: HandoffSet) -> tuple[list[str], list[str]]:
    """Splits objects into those with start states and those without.

    Raises:
        InputError: None has any.
    """
    have, without = eligible(names, handoffs)
    if not have:
        counts = handoffs.counts()
        known = ", ".join(n for n in counts if counts[n]) or "none"
        raise InputError("--objects", ", ".join(names), f"objects with pre-grasps ({known})")
    return have, without


def _build(scene: Scene, handoffs: HandoffSet, config: TrainConfig, console: Console) -> World:
    """The scene with the training's share of the start states."""
    names, without = _trainable(scene.object_names, handoffs)
    if without:
        console.print(f"[yellow]not eligible, left out: {', '.join(without)}[/yellow]")
    return build_world(scene, states_of(handoffs, names, "training"), config.task)


def to_json(config: Any) -> Any:
    """A configuration as plain JSON values."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_json(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, Path):
        return str(config)
    if isinstance(config, tuple):
        return [to_json(x) for x in config]
    return config


def from_json(stored: dict[str, Any]) -> TrainConfig:
    """The configuration that `to_json` wrote.

    Raises:
        InputError: A field is unknown or its value is not allowed.
    """
    nested = {
        "scene": SceneConfig,
        "task": ClosingConfig,
        "noise": StartNoise,
        "ppo": PPOConfig,
        "loop": LoopConfig,
    }

    def build(kind: type, values: dict[str, Any]) -> Any:
        known = {f.name for f in dataclasses.fields(kind)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InputError(f"{kind.__name__} fields", unknown, f"fields of {sorted(known)}")
        return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})

    paths = ("objects_dir", "handoffs", "out", "resume")
    values = {
        k: build(nested[k], v) if k in nested else Path(v) if k in paths and v else v
        for k, v in stored.items()
    }
    return build(TrainConfig, values)


def _open_run(config: TrainConfig) -> Path:
    """The run's folder; a new run's configuration and provenance are written to it."""
    if config.resume is not None:
        return config.resume
    folder = config.out or Path("runs") / f"{config.preset}-{time.strftime('%Y%m%d-%H%M%S')}"
    if (folder / "config.json").exists():
        raise FileError(
            folder, "a run that is already there", f"another --out, or --resume {folder}"
        )
    check_writable("--out", folder / "config.json")
    contents = (to_json(config), provenance(config.seed))
    for name, content in zip(_OPENING, contents, strict=True):
        with replacing(folder / name) as temporary:
            temporary.write_text(json.dumps(content, indent=2))
    return folder


def _discard_run(folder: Path) -> None:
    """Takes back what `_open_run` wrote, for a run that cannot begin."""
    for name in _OPENING:
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _made_handoffs(config: TrainConfig, folder: Path, console: Console) -> HandoffSet:
    """The set in the run's folder, made now if it is not there yet."""
    path = folder / "handoffs.npz"
    if not path.exists():
        from mjx_grasp.handoffs import make_handoffs

        console.print("making handoff states (give --handoffs to use a stored set)")
        make_handoffs(
            HandoffConfig(
                objects=config.objects,
                objects_dir=config.objects_dir,
                per_object=config.handoffs_per_object,
                seed=config.seed,
                out=path,
            )
        )
    return load_handoffs(path)


def _fit_worlds(config: TrainConfig, scene: Scene) -> PPOConfig:
    if not config.fit_memory:
        return config.ppo
    worlds = worlds_that_fit(scene, config.ppo.unroll, device_memory())
    return replace(config.ppo, worlds=worlds)


def _save_policy(
    folder: Path, state: TrainState, config: TrainConfig, names: list[str], ppo: PPOConfig
) -> None:
    meta = {
        "task": to_json(config.task),
        "objects": names,
        "env_steps": int(state.iteration) * ppo.steps_per_iteration,
        "provenance": json.loads((folder / "provenance.json").read_text()),
    }
    policy_from_training(state.params.policy, state.normalizer, meta).save(folder / "policy.npz")


def parse(argv: list[str]) -> TrainConfig:
    """The configuration of a command line: the preset's, changed by the flags.

    A resumed run takes its stored configuration and nothing else.

    Raises:
        FileError: The run to resume has no configuration.
        InputError: Flags beside `--resume`, or an impossible setting.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="auto")
    first.add_argument("--resume", type=Path)
    known, others = first.parse_known_args(argv)
    if known.resume is not None:
        if others or known.preset != "auto":
            raise InputError("--resume", " ".join(argv), "no other flag: a run keeps its settings")
        return stored_config(known.resume)
    default = preset_config(known.preset)
    asked = replace(default, preset=known.preset)  # so that the help's default is auto, not cpu
    config = tyro.cli(TrainConfig, args=argv, default=asked, description=__doc__)
    return replace(config, preset=default.preset)


def stored_config(folder: Path) -> TrainConfig:
    """The configuration of a run, set to be resumed.

    Raises:
        FileError: There is no readable configuration.
    """
    path = folder / "config.json"
    try:
        stored = json.loads(path.read_text())
    except FileNotFoundError:
        raise FileError(folder, "no run: config.json is missing", "a run's folder") from None
    except (OSError, ValueError) as error:
        raise FileError(path, f"no readable configuration ({error})", "a run's folder") from None
    return replace(from_json(stored), resume=folder)


def main() -> None:
    """The command."""
    console = Console(stderr=True)
    train(parse(sys.argv[1:]), console)


if __name__ == "__main__":
    run_command(main)
