"""The publication's tables and figures, made again: one part each, with everything it needs.

  python experiments/paper.py --list
  python experiments/paper.py --objects-dir SCANS reach eight
  python experiments/paper.py --objects-dir SCANS

What is done for this revision of the code is not done again, so that a run that was stopped goes
on; several of the commands go on within themselves too. The last step puts the numbers into the
READMEs.
`docs/reproduction.md` says where each table and figure is shown.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.console import Console
from rich.table import Table

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluation.paper import EPISODES
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.provenance import (
    device_name,
    git_revision,
    is_committed,
    provenance,
    usable_cores,
)
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.tasks.assemble import has_gpu

ROOT = Path(__file__).resolve().parent.parent
SCHEMA = "mjx_grasp.paper/1"
REACHED = "assets/handoffs_reached.npz"
FOLDER = "runs/paper"
"""of what is no result: states and policies on the way, and what is done"""
STATES = (
    "-m mjx_grasp.handoffs --kind reached --gate paper --objects train --per-object 42 "
    f"--max-rounds 4 --objects-dir SCANS --processes SHARERS --out {FOLDER}/handoffs.npz"
)
END_TO_END = "-m mjx_grasp.train --preset end-to-end --objects-dir SCANS --evaluation-episodes 0"
AS_PUBLISHED = f"{END_TO_END} --handoffs {FOLDER}/handoffs.npz --scene.physics-dt 0.005"
OURS = (
    f"{END_TO_END} --objects eight --handoffs {REACHED} "
    "--scene.physics-dt 0.005 --scene.fix-idle-fingers "
    "--ppo.worlds 8192 --ppo.unroll 32 --ppo.tuning 0 --ppo.averaged 0.1 "
    "--ppo.privileged-critic --ppo.critic-rate 3e-4 --ppo.value-clip 0.5 --ppo.hidden 256 256 "
    "--ppo.action-std 0.15 --task.action.others --task.reach-rate 2 --task.action.arm-rate 0.15 "
    "--task.action.residual leaky --task.given-up 0.08 --task.raised 0.15 "
    "--task.curriculum.kind measured --task.curriculum.until 0.8 --task.curriculum.step 0.05 "
    "--task.curriculum.window 4000 --task.curriculum.frontier 0.5 "
    "--task.reward.reach 0 --task.reward.way-left 300 --task.reward.posture 100 "
    "--task.reward.held 4 --task.reward.hard -0.2 --task.observation.normals "
    "--task.observation.arm --task.observation.others --task.observation.forces "
    "--task.grip.force 2.5 --task.grip.split balanced --task.grip.direction line "
    "--task.grip.follow 0.05 --task.grip.settles --task.grip.friction 0.4 "
    "--task.grip.arrival 0.005 --task.grip.approach-s None --task.grip.freezes "
    "--task.grip.together --task.lift.delay-s 0.5"
)
"""end to end with our critic, grip, rewards and way home, all joints and a faster arm"""
HELPED = "--task.assisted --task.within 0.04"
"""guidance moves the fingers too, once they are near"""
PACED = "--task.reach-rate 1"
"""the arm as fast as reaching keeps to"""


def _paced(word: str, more: str, alone: bool = True) -> dict[str, str]:
    """Trainings with the arm at that speed: two that are guided, and one that is not."""
    ours = f"{OURS} {more}"
    helped = {f"e2e-paced{word}-{k}": f"{ours} {HELPED} {PACED} --seed {k}" for k in (0, 1)}
    return helped | ({f"e2e-paced-alone{word}-0": f"{ours} {PACED}"} if alone else {})


SHORTER = _paced("", "--ppo.iterations 1500")
LONGER = _paced("-long", "--ppo.iterations 2300")
EARLIER = _paced("-early", "--ppo.iterations 2300 --task.curriculum.until 0.4", alone=False)
"""As long, but forced to the whole way after half as many iterations."""
END_TO_END_RUNS = {
    **{f"e2e-paper-{k}": f"{AS_PUBLISHED} --seed {k}" for k in (0, 1)},
    **{f"e2e-helped-{k}": f"{OURS} --ppo.iterations 1500 {HELPED} --seed {k}" for k in (0, 1)},
    "e2e-alone-0": f"{OURS} --ppo.iterations 1500",
    **SHORTER,
    **LONGER,
    **EARLIER,
    "e2e-slow-0": (
        f"{OURS} --ppo.iterations 620 {HELPED} --task.reach-rate 0.5 "
        "--task.action.no-others --task.observation.no-others"
    ),
    "e2e-straight-0": (
        f"{OURS} --ppo.iterations 620 {HELPED} --task.raised 0 --task.reward.posture 0"
    ),
}
"""How each is trained."""
DRAWN = [run for run in END_TO_END_RUNS if run not in SHORTER | EARLIER]
"""Whose curves are drawn: of those with the slower arm the long ones."""


@dataclass(frozen=True)
class Part:
    """One table or figure of the publication."""

    name: str
    shows: str
    commands: tuple[str, ...]
    """relative to the repository; `SCANS` stands for the folder of scans, `CORES` for the number of
    cores, `SHARERS` for that of processes that share a GPU, or without one the cores; `TRIALS:56`
    for as many trials as published in MJX on a GPU, or without one 56 in native MuJoCo; `GRASPS`
    for whole grasps in MJX on a GPU that some processes share, or in native MuJoCo"""
    without_gpu: str | None = None
    """what it takes without a GPU, where that is too much; None: every machine can do it"""


PARTS = (
    Part(
        "heatmaps",
        "heatmaps of the 28 objects, which can be grasped, and their ranking",
        (
            "experiments/heatmap_figure.py --objects-dir SCANS",
            "experiments/heatmap_ranking.py --objects-dir SCANS",
            "experiments/eligibility.py --objects-dir SCANS",
        ),
    ),
    Part(
        "steering",
        "default against anchored selection, and the grasps that come of it",
        (
            "experiments/steering_figure.py --objects-dir SCANS",
            "experiments/steering_numbers.py --objects-dir SCANS",
            "experiments/steered_grasps.py --objects-dir SCANS GRASPS",
        ),
    ),
    Part(
        "reach",
        "convergence of reaching over tolerance and time",
        (
            "-m mjx_grasp.sweep_reach --processes CORES "
            "--out experiments/results/reach_sweep_cpu.json --plot docs/reach_sweep.png",
        ),
    ),
    Part(
        "handoffs",
        "tip errors at handoffs that the reaching controller comes to",
        (
            "-m mjx_grasp.handoffs --kind reached --objects train held_out --objects-dir SCANS "
            "--per-object 128 --max-rounds 5 --processes SHARERS "
            "--out experiments/results/handoffs_reached.npz",
        ),
    ),
    Part(
        "eight",
        "success, forces and failure classes on the eight objects, policy and squeeze",
        (
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal hard "
            "--force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 --squeeze-forces 1 2 3 4 5 7 10 "
            "--grip-frictions 0.4 0.5 --episodes 128 "
            "--processes CORES --out experiments/results/eight_native.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --no-with-policy "
            "--conditions nominal hard --squeeze-splits even balanced "
            "--squeeze-forces 1 2 3 4 5 6 7 8 9 10 11 12 --episodes 128 "
            "--known experiments/results/eight_native.json "
            "--processes CORES --out experiments/results/squeezes/eight.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions offset10 "
            "offset20 friction04 friction05 friction11 light heavy --force-budgets 3 8 "
            "--squeeze-forces 2 3 5 8 12 --grip-frictions 0.4 "
            "TRIALS:64 --out experiments/results/conditions/exact.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --noisy-torque --conditions "
            "nominal offset10 offset20 friction04 friction05 friction11 light heavy hard "
            "--force-budgets 3 8 --squeeze-forces 3 5 8 --grip-frictions 0.4 "
            "TRIALS:32 --out experiments/results/conditions/noisy.json",
            "experiments/force_figure.py",
            "experiments/least_force.py --objects-dir SCANS",
        ),
    ),
    Part(
        "engines",
        "not of it: the same trials in native MuJoCo and in MJX",
        (
            "experiments/evaluate_controllers.py --engine mjx --objects-dir SCANS "
            "--conditions nominal hard --force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 "
            "--squeeze-forces 1 2 3 4 5 7 10 --grip-frictions 0.4 0.5 --episodes 128 "
            "--out experiments/results/engines/eight.json",
        ),
        without_gpu="MJX takes days for them on a few cores",
    ),
    Part(
        "objects",
        "success on all objects that have start states, held-out ones too",
        (
            "-m mjx_grasp.handoffs --kind reached --objects train held_out --per-object 96 "
            "--max-rounds 3 --seed 11 --objects-dir SCANS --processes SHARERS "
            f"--out {FOLDER}/reached_all.npz",
            "experiments/evaluate_controllers.py --objects-dir SCANS --objects train held_out "
            f"--handoffs {FOLDER}/reached_all.npz --states all --force-budgets 3 6 12 "
            "--squeeze-forces 3 --grip-frictions 0.4 "
            "TRIALS:24 --out experiments/results/objects/reached.json",
            "experiments/least_force.py --objects-dir SCANS --objects train held_out "
            f"--handoffs {FOLDER}/reached_all.npz --frictions 0.8 "
            "--out experiments/results/objects/least_force.json",
            f"experiments/heavy_objects.py --objects-dir SCANS --handoffs {FOLDER}/reached_all.npz "
            "--processes CORES",
        ),
    ),
    Part(
        "pose-error",
        "success over errors of the object's pose at the handoff",
        (
            "experiments/pose_error.py --objects-dir SCANS TRIALS:56",
            "experiments/pose_error_figure.py",
        ),
    ),
    Part(
        "sensitivity",
        "success where friction, mass, finger stiffness or torque limits are not as modelled",
        (
            "experiments/sensitivity.py --objects-dir SCANS TRIALS:16",
            "experiments/sensitivity_figure.py",
        ),
    ),
    Part(
        "stability",
        "rise, forces and the wrench that is left while an object is held",
        ("experiments/lift_stability.py --objects-dir SCANS --processes CORES",),
    ),
    Part(
        "scenarios",
        "whole grasps from home, with what the hardware demonstrations show",
        (
            "-m mjx_grasp.scenarios --objects-dir SCANS --objects train held_out "
            "--scenarios nominal --episodes 64 --seed 9 "
            "GRASPS --out experiments/results/grasps_all.json",
            "-m mjx_grasp.scenarios --objects-dir SCANS --objects eight --episodes 64 --seed 9 "
            "GRASPS --out experiments/results/scenarios.json",
        ),
    ),
    Part(
        "ablation",
        "whole grasps without one part of the method each, and a policy that only knows its budget",
        (
            "experiments/pipeline_ablation.py --objects-dir SCANS --episodes 16 GRASPS",
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal hard "
            "--force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 --keeping-gain 0 --squeeze-forces "
            "--episodes 128 --processes CORES --out experiments/results/not_kept/eight.json",
            "experiments/pipeline_ablation.py --objects-dir SCANS --objects bowl toy_airplane "
            "pitcher_base mug cracker_box --variants full sideways walls-alike --scenarios nominal "
            "--episodes 24 GRASPS "
            "--out experiments/results/pipeline_ablation_walls.json",
        ),
    ),
    Part(
        "paper-policy",
        "a policy trained as published, for the rows of the preset `paper`",
        (
            STATES,
            "-m mjx_grasp.train --preset paper --objects-dir SCANS "
            f"--handoffs {FOLDER}/handoffs.npz --evaluation-episodes 0 --out {FOLDER}/seed0",
            f"experiments/collect_runs.py --replace {FOLDER}/seed0",
        ),
        without_gpu="its 31 M steps take days on a few cores",
    ),
    Part(
        "end-to-end",
        "the baseline: one policy from home to the lift, as published and with our settings",
        (
            STATES,
            *(f"{train} --out {FOLDER}/{run}" for run, train in END_TO_END_RUNS.items()),
            *(
                "experiments/evaluate_controllers.py --objects-dir SCANS "
                f"--policy {FOLDER}/{run}/policy.npz --force-budgets 3 --squeeze-forces "
                f"--episodes 32 --processes CORES --out experiments/results/end_to_end/{run}.json"
                for run in END_TO_END_RUNS
            ),
            *(
                f"experiments/{script} " + " ".join(f"{FOLDER}/{run}" for run in runs)
                for script, runs in (
                    ("collect_runs.py --replace", END_TO_END_RUNS),
                    ("learning_curves.py", DRAWN),
                )
            ),
        ),
        without_gpu="its trainings of 31 to 603 M steps take weeks on a few cores",
    ),
)
LAST = "experiments/make_readme.py"
_TRIALS = "TRIALS:"
_IN_MJX = "--engine", "mjx"
_GRASPS = "GRASPS"
_CORES_EACH = 2
"""Of processes that share a GPU: each compiles for minutes on one core, and then steps on all."""
_CORES_EACH_IN_MJX = 4
"""The same where the GPU steps too, which a few processes keep busy."""


@dataclass(frozen=True)
class PaperConfig(CommandSettings):
    """Which parts to make."""

    parts: tyro.conf.Positional[tuple[str, ...]] = ()
    """by name; all of them if none is named"""
    list: bool = False
    """only say what there is, and what of it is done"""
    objects_dir: Path | None = None
    """folder of real scans"""
    state: Path = ROOT / FOLDER / "state.json"
    """where what is done is noted, and how long it took"""


def chosen(names: tuple[str, ...]) -> list[Part]:
    """Parts by name, in their own order.

    Raises:
        InputError: There is no such part.
    """
    known = [part.name for part in PARTS]
    for name in names:
        if name not in known:
            raise InputError("parts", name, f"some of {', '.join(known)}")
    return [part for part in PARTS if not names or part.name in names]


def machine() -> str:
    """What this runs on, in words."""
    device = jax.devices()[0]
    cores = "" if device.platform == "cpu" else f", {usable_cores()} cores"
    return f"{device_name(device)}{cores}"


def digest_of(scans: Path) -> str:
    """What tells a folder of scans from another one: its files, by name and size."""
    files = sorted(path for path in scans.rglob("*") if path.is_file())
    listed = [f"{path.relative_to(scans).as_posix()} {path.stat().st_size}" for path in files]
    return hashlib.sha256("\n".join(listed).encode()).hexdigest()


def done(state: dict[str, Any], command: str, scans: Path | None) -> bool:
    """Whether a command has ended well at this revision of the code, with these scans.

    With uncommitted changes nothing has, as the revision does not know them; nor has what lacks
    the file or folder that it made.
    """
    entry, git = state.get(command, {}), git_revision()
    same = scans is None or entry.get("scans") == digest_of(scans)
    return entry.get("git") == git and same and is_committed(git) and made_by(command).exists()


def made_by(command: str) -> Path:
    """What a command makes, as far as it says so by `--out`; else the repository."""
    words = shlex.split(command)
    return ROOT / words[words.index("--out") + 1] if "--out" in words else ROOT


def listed(parts: list[Part], state: dict[str, Any], scans: Path | None) -> Table:
    """What there is."""
    table = Table("part", "what of the publication", "commands done", "s, before", box=None)
    for part in parts:
        ready = sum(done(state, command, scans) for command in part.commands)
        before = [state[c]["seconds"] for c in part.commands if c in state]
        seconds = f"{sum(before):.0f}" if before else "?"
        shown = part.shows + (" (needs a GPU)" if part.without_gpu else "")
        table.add_row(part.name, shown, f"{ready} of {len(part.commands)}", seconds)
    return table


def main(config: PaperConfig) -> None:
    """Makes what is not done."""
    console, parts = Console(stderr=True), chosen(config.parts)
    what = "the state of experiments/paper.py"
    kept = read_json(config.state, what) if config.state.exists() else {}
    if kept and kept.get("schema") != SCHEMA:
        raise FileError(config.state, f"schema {kept.get('schema')!r}", SCHEMA)
    state: dict[str, Any] = kept.get("commands", {})
    if config.list:
        Console().print(listed(parts, state, config.objects_dir))
        return
    if config.objects_dir is None or not config.objects_dir.is_dir():
        found = str(config.objects_dir) if config.objects_dir else "nothing"
        raise InputError("--objects-dir", found, "the folder of the scans")
    todo: dict[str, str] = {}
    for part in parts:
        if part.without_gpu and not has_gpu():
            console.print(f"[yellow]{part.name} needs a GPU: {part.without_gpu}[/yellow]")
            continue
        for command in part.commands:
            if not done(state, command, config.objects_dir):
                todo.setdefault(command, part.name)  # two parts may share one
    began, made = time.monotonic(), provenance(seed=0)
    for k, (command, name) in enumerate(todo.items()):
        left = [state.get(c, {}).get("seconds") for c in list(todo)[k:]]
        known = [x for x in left if x is not None]
        guess = f", about {sum(known) / 60:.0f} min left" if len(known) == len(left) else ""
        spent = (time.monotonic() - began) / 60
        console.print(f"[bold]{k + 1}/{len(todo)} {name}[/bold], {spent:.0f} min so far{guess}")
        started = time.monotonic()
        _run(command, config.objects_dir, console)
        state[command] = {
            "git": git_revision(),
            "scans": digest_of(config.objects_dir),
            "seconds": round(time.monotonic() - started, 1),
            "machine": machine(),
        }
        write_json(config.state, {"schema": SCHEMA, "commands": state, "provenance": made})
    _run(LAST, config.objects_dir, console)


def going_on(words: list[str]) -> list[str]:
    """A command, or of a training that was stopped the one that goes on with it.

    A run by another command or revision of the code stays, under another name.
    """
    if words[:2] != ["-m", "mjx_grasp.train"]:
        return words
    folder = ROOT / words[words.index("--out") + 1]
    if not (folder / "config.json").exists():
        return words
    begun = folder / "provenance.json"
    made = read_json(begun, "the provenance of a run") if begun.exists() else {}
    git = git_revision()
    same = made.get("command") == shlex.join(["python", *words]) and made.get("git") == git
    if same and is_committed(git):
        return [*words[:2], "--resume", os.path.relpath(folder, ROOT)]
    names = (folder.with_name(f"{folder.name}.before-{k}") for k in count(1))
    folder.rename(next(name for name in names if not name.exists()))
    return words


def worded(command: str, scans: Path) -> list[str]:
    """A command as it is typed on this machine, without Python's name."""
    cores, gpu = usable_cores(), has_gpu()
    sharers = max(1, cores // _CORES_EACH) if gpu else cores
    there = os.path.relpath(scans, ROOT)  # results keep the command
    given = {"SCANS": there, "CORES": str(cores), "SHARERS": str(sharers)}
    words = []
    for word in shlex.split(command):
        few = word.removeprefix(_TRIALS)
        if word == _GRASPS:
            beside = max(1, cores // _CORES_EACH_IN_MJX) if gpu else cores
            words += [*(_IN_MJX if gpu else ()), "--processes", str(beside)]
        elif few == word:
            words.append(given.get(word, word))
        elif gpu:
            words += [*_IN_MJX, "--episodes", str(EPISODES)]
        else:
            words += ["--episodes", few, "--processes", str(cores)]
    return words


def _run(command: str, scans: Path, console: Console) -> None:
    """Runs a command of this repository in its root.

    Raises:
        MjxGraspError: It failed.
    """
    words = going_on(worded(command, scans))
    console.print(f"[dim]python {shlex.join(words)}[/dim]")
    (ROOT / FOLDER).mkdir(parents=True, exist_ok=True)  # commands write there
    # Processes that share all cores would only wait for each other on one GPU.
    env = os.environ | ({"JAX_PLATFORMS": "cpu"} if "CORES" in command else {})
    shared = any(word in command for word in ("SHARERS", _GRASPS))
    env |= {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} if shared else {}
    code = subprocess.run([sys.executable, *words], cwd=ROOT, env=env, check=False).returncode
    if code:
        raise MjxGraspError(
            f"python {shlex.join(words)}: ended with {code}; once it is mended, the same command "
            "goes on here"
        )


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PaperConfig, description=__doc__)))
