"""The commands as a user types them: handoffs, train, evaluate, resume, and their refusals."""

from __future__ import annotations

import hashlib
import io
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import handmade
import numpy as np
import pytest
from rich.console import Console
from typed import refusal, typed

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.learning.run import LoopConfig
from mjx_grasp.sim.scene import SceneConfig, build_scene
from mjx_grasp.tasks.assemble import World, build_scene_of
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.training import config as training_config
from mjx_grasp.training import job
from mjx_grasp.training.after import GRIP_FRICTIONS, SQUEEZE_FORCES_N
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.config import preset_config, stored_config
from mjx_grasp.training.job import run_training

TINY = (
    *("--objects", "foam_brick", "--evaluation-episodes", "2", "--ppo.worlds", "8"),
    *("--ppo.unroll", "4", "--ppo.iterations", "2", "--task.episode-s", "0.3"),
    *("--task.observation.no-budget", "--start-from", "None"),
)
STATES = asset_path("handoffs_standins.npz")


def command(module: str, *arguments: str | Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", f"mjx_grasp.{module}", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=400,
    )


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [("mesh.obj", "v 0 0 0", "ending in .json"), ("grasps.json", "{}", "is another file")],
)
def test_an_evaluation_replaces_results_alone(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    asked = ("--controller", "grip", "--objects", "foam_brick", "--out", tmp_path / name)
    done = typed("evaluate", *asked)
    assert done.returncode == 2 and said in " ".join(done.stderr.replace("│", " ").split())
    assert (tmp_path / name).read_text() == content


def test_the_package_says_which_commands_there_are():
    done = typed("__main__")
    listed = re.findall(r"python -m (mjx_grasp\.\S+)", done.stdout)
    some = {"mjx_grasp.demo", "mjx_grasp.train", "mjx_grasp.viz.video", "mjx_grasp.robot.spec"}
    assert some <= set(listed)
    for name in listed:
        file = Path(__file__).parents[1] / f"{name.replace('.', '/')}.py"
        assert "run_command(" in file.read_text(), name


def test_help_and_mistakes_say_what_is_typed():
    for flags in (["--help"], ["--no-such-flag"]):
        done = command("export", *flags)
        assert "python -m mjx_grasp.export" in done.stdout + done.stderr
        assert "export.py" not in done.stdout + done.stderr


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two iterations on the brick's stand-in."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    done = typed("train", "--preset", "cpu", *TINY, "--handoffs", STATES, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.long
def test_a_training_without_start_states_makes_its_own(tmp_path):
    folder, made = tmp_path / "tiny", ("--handoffs-kind", "ik", "--handoffs-per-object", "8")
    none = ("--evaluation-episodes", "0", "--out", folder)
    done = command("train", "--preset", "cpu", *TINY, *made, *none)
    assert done.returncode == 0, done.stderr
    assert len(load_handoffs(folder / "handoffs.npz")) == 8


def test_a_training_leaves_everything_behind(trained):
    present = {p.name for p in trained.iterdir()}
    assert present >= {
        *("config.json", "provenance.json", "metrics.csv", "policy.npz", "results.json"),
        *("report.html", "checkpoints", "tensorboard", "grasp.npz"),
    }
    assert len((trained / "metrics.csv").read_text().splitlines()) == 3
    assert load_policy(trained / "policy.npz").meta["objects"] == ["foam_brick"]
    results = read_results(trained / "results.json")
    assert (results.extra["overflows"], results.extra["broken_worlds"]) == (0, 0)
    rows = results.rows
    assert [(r.controller, r.squeeze_force_n, r.grip_friction) for r in rows] == [
        ("policy", None, None),
        *(("squeeze", force, None) for force in SQUEEZE_FORCES_N),
        *(("grip", None, friction) for friction in GRIP_FRICTIONS),
    ]
    assert all(len(r.outcomes) == r.episodes == 2 for r in rows)
    assert "foam" in (trained / "report.html").read_text()


@pytest.mark.long
def test_a_finished_run_resumes_to_the_same_policy(trained):
    before = (trained / "policy.npz").read_bytes()
    config = json.loads((trained / "config.json").read_text())
    (trained / "config.json").write_text(json.dumps(config | {"evaluation_episodes": 0}))
    done = command("train", "--resume", trained)
    assert done.returncode == 0, done.stderr
    assert "resumed from iteration_00000002" in done.stderr
    assert (trained / "policy.npz").read_bytes() == before


def test_a_run_goes_on_from_the_start_states_it_began_with(
    trained, scene, tmp_path, monkeypatch, capsys
):
    states, run = tmp_path / "states.npz", tmp_path / "run"
    states.write_bytes(STATES.read_bytes())
    config = replace(stored_config(trained), handoffs=states, resume=None, out=run)
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    monkeypatch.setattr(job, "_build", lambda *_: "a world")
    monkeypatch.setattr(job, "_run", lambda *_: None)
    monkeypatch.setattr(job, "made_handoffs", lambda *_: None)
    run_training(config, Console(quiet=True))
    run_training(stored_config(run), Console(quiet=True))
    states.write_bytes(asset_path("handoffs_reached.npz").read_bytes())
    status, error = refusal(monkeypatch, capsys, "train", "--resume", run)
    assert status == 2
    assert "states.npz: found a changed file" in error and str(run) in error


def test_a_run_goes_on_with_the_policy_it_began_with(scene, tmp_path, monkeypatch, capsys):
    policy, run = tmp_path / "first.npz", tmp_path / "run"
    policy.write_bytes(asset_path("policy.npz").read_bytes())
    states = asset_path("handoffs_standins.npz")
    config = replace(preset_config("cpu"), handoffs=states, objects=("foam_brick",), out=run)
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    monkeypatch.setattr(job, "_build", lambda *_: "a world")
    monkeypatch.setattr(job, "_run", lambda *_: None)
    run_training(replace(config, start_from=str(policy)), Console(quiet=True))
    run_training(stored_config(run), Console(quiet=True))
    policy.unlink()  # the run has a copy: whatever ships later
    run_training(stored_config(run), Console(quiet=True))
    own = load_policy(run / "start.npz")
    replace(own, meta=own.meta | {"more": 1}).save(run / "start.npz")
    status, error = refusal(monkeypatch, capsys, "train", "--resume", run)
    assert status == 2
    assert "start.npz: found a changed file" in error and str(run) in error


def test_a_run_says_by_which_versions_it_was_resumed(scene, tmp_path, monkeypatch):
    states, run = asset_path("handoffs_standins.npz"), tmp_path / "run"
    config = replace(preset_config("cpu"), handoffs=states, objects=("foam_brick",), out=run)
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    monkeypatch.setattr(job, "_build", lambda *_: "a world")
    monkeypatch.setattr(job, "_run", lambda *_: None)
    run_training(config, Console(quiet=True))
    began = json.loads((run / "provenance.json").read_text())
    run_training(stored_config(run), Console(quiet=True))
    assert json.loads((run / "provenance.json").read_text()) == began
    monkeypatch.setattr("mjx_grasp.records.provenance.git_revision", lambda: "later")
    for _ in range(2):
        run_training(stored_config(run), Console(quiet=True))
    now = json.loads((run / "provenance.json").read_text())
    (resumed,) = now.pop("resumed")
    assert now == began and resumed["git"] == "later"


def test_a_run_with_terms_of_its_own_goes_on_with_them_alone(scene, tmp_path, monkeypatch, capsys):
    states, run = asset_path("handoffs_standins.npz"), tmp_path / "run"
    config = replace(preset_config("cpu"), handoffs=states, objects=("foam_brick",), out=run)
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    monkeypatch.setattr(job, "_build", lambda *_: "a world")
    own = (RewardTerm("gentle", -0.2, lambda moment: moment.force),)

    def stopped(*_):
        raise KeyboardInterrupt("interrupted")

    with monkeypatch.context() as patch:
        patch.setattr(job, "_run", stopped)
        with pytest.raises(KeyboardInterrupt, match=r"script.*resume=.*run"):
            run_training(config, Console(quiet=True), extra_terms=own)
    monkeypatch.setattr(job, "_run", lambda *_: None)
    run_training(stored_config(run), Console(quiet=True), extra_terms=own)
    status, error = refusal(monkeypatch, capsys, "train", "--resume", run)
    assert status == 2
    assert "extra reward terms [] now" in error and "gentle" in error


def test_objects_without_a_state_to_be_judged_from_are_refused_or_named(robot):
    stored, names = load_handoffs(asset_path("handoffs_standins.npz")), ("foam_brick", "apple")
    of = [np.flatnonzero(stored.object_index == stored.object_names.index(n)) for n in names]
    scene = build_scene_of(names, None, robot, SceneConfig())
    config = preset_config("cpu")

    def built(config, *which):
        heard = Console(record=True, file=io.StringIO(), width=200)
        world = job._build(scene, stored.take(np.concatenate(which)), config, heard)
        return len(world.starts.object_index), heard.export_text()

    with pytest.raises(InputError, match=r"--evaluation-episodes.*no object"):
        built(config, of[0][:1], of[1][:1])
    assert built(replace(config, evaluation_episodes=0), of[0][:1], of[1][:1]) == (2, "")
    count, said = built(config, of[0][:1], of[1][:8])
    assert count == 7 and "not evaluated: foam_brick" in said and "apple" not in said


def test_a_run_says_which_states_it_is_trained_on(scene, tmp_path, monkeypatch):
    stored = load_handoffs(asset_path("handoffs_standins.npz")).select(["foam_brick"])
    states, run = tmp_path / "states.npz", tmp_path / "run"
    replace(stored, reached=np.arange(len(stored)) % 2 == 0).save(states)
    monkeypatch.setattr(job, "_build", lambda *_: "a world")
    monkeypatch.setattr(job, "_run", lambda *_: None)
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    config = replace(preset_config("cpu"), handoffs=states, objects=("foam_brick",), out=run)
    run_training(config, Console(quiet=True))
    made = json.loads((run / "provenance.json").read_text())
    share = round(np.mean(np.arange(len(stored)) % 2 == 0), 4)
    assert made["handoffs"] == {"kind": "mixed", "reached_share": share}


def test_what_cannot_work_is_refused_before_a_folder_is_made(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    states = asset_path("handoffs_standins.npz")
    run, task = tmp_path / "run", replace(preset_config("cpu").task, control_dt=0.0071)
    config = replace(preset_config("cpu"), handoffs=states, objects=("foam_brick",), out=run)
    with pytest.raises(InputError, match=r"control_dt: found 0\.0071"):
        run_training(replace(config, task=task), Console(quiet=True))
    assert not run.exists()
    run.mkdir()
    (run / "handoffs.npz").write_bytes(states.read_bytes())
    with pytest.raises(FileError, match=r"handoffs\.npz, of no run"):
        run_training(config, Console(quiet=True))
    assert [path.name for path in run.iterdir()] == ["handoffs.npz"]


def test_a_run_is_never_overwritten(trained):
    done = typed("train", "--preset", "cpu", *TINY, "--out", trained)
    assert done.returncode == 2
    assert "a run that is already there" in done.stderr


def test_evaluate_writes_rows_of_the_stated_condition(tmp_path):
    out = tmp_path / "squeeze.json"
    done = typed(
        *("evaluate", "--controller", "squeeze", "--squeeze-force", "4", "--objects"),
        *("foam_brick", "--episodes", "3", "--handoffs", STATES),
        *("--states", "all", "--offset-mm", "2", "--angle-deg", "3", "--friction", "0.6"),
        *("--seed", "5", "--out", out),
    )
    assert done.returncode == 0, done.stderr
    results = read_results(out)
    (row,) = results.rows
    assert (row.object, row.episodes, row.squeeze_force_n) == ("foam_brick", 3, 4.0)
    assert (row.offset_mm, row.angle_deg, row.friction, row.handoffs) == (2.0, 3.0, 0.6, "reached")
    assert row.successes + row.never_lifted + row.not_held + row.slipped == 3
    assert results.provenance["seed"] == 5
    assert (results.extra["overflows"], results.extra["broken_worlds"]) == (0, 0)
    assert results.provenance["command"].startswith("python -m mjx_grasp.evaluate --controller")
    assert results.extra["settings"]["states"] == "all"
    handoffs = hashlib.sha256(STATES.read_bytes()).hexdigest()
    assert results.extra["sha256"] == {"handoffs": handoffs}


@pytest.mark.long
def test_evaluate_runs_a_grip_that_feels_in_a_poor_robot(tmp_path):
    out = tmp_path / "grip.json"
    done = command(
        *("evaluate", "--controller", "grip", "--grip.friction", "0.5", "--objects", "foam_brick"),
        *("--episodes", "3", "--handoffs", STATES, "--states", "all"),
        *("--mass-scale", "1.5", "--robot-errors.torque-std", "0.01", "--out", out),
    )
    assert done.returncode == 0, done.stderr
    results = read_results(out)
    (row,) = results.rows
    assert (row.controller, row.squeeze_force_n, row.mass_scale) == ("grip", None, 1.5)
    assert (row.grip_force_n, row.grip_friction) == (2.5, 0.5)
    assert len(row.forces_n) == len(row.starts) == 3
    lifted = [force for force in row.forces_n if force is not None]
    if lifted:
        assert abs(sum(lifted) / len(lifted) - row.force_mean_n) < 1e-2
        assert row.force_peak_p50_n <= row.force_peak_p99_n <= row.force_peak_n
    assert results.extra["settings"]["robot_errors"]["torque_std"] == 0.01


def test_evaluate_refuses_before_anything_long(trained, tmp_path, monkeypatch, capsys):
    out = tmp_path / "x.json"
    for arguments, text in (
        (("--objects", "foam_brik"), "foam_brick"),
        (("--policy", tmp_path / "none.npz"), "no such file"),
        (("--handoffs", trained / "policy.npz", "--objects", "foam_brick"), "policy.npz"),
    ):
        status, error = refusal(monkeypatch, capsys, "evaluate", *arguments, "--out", out)
        assert status == 2, error
        assert text in error
        assert not out.exists()


def test_presets_differ_as_they_say(monkeypatch):
    paper = preset_config("paper")
    assert (paper.ppo.worlds, paper.ppo.unroll, paper.ppo.iterations) == (1024, 64, 470)
    assert paper.task.action.residual == "integrated"
    assert not paper.ppo.privileged_critic
    assert paper.ppo.iterations * paper.ppo.steps_per_iteration == 30_801_920
    cpu = preset_config("cpu")
    assert cpu.engine == "mujoco"
    assert len(cpu.objects) == 1
    monkeypatch.setattr(training_config, "has_gpu", lambda: False)
    with pytest.raises(InputError, match="GPU"):
        preset_config("gpu")
    with pytest.raises(InputError, match="huge"):
        parse(["--preset", "huge"])


def test_resume_takes_no_other_flag(tmp_path):
    with pytest.raises(InputError, match="no other flag"):
        parse(["--resume", str(tmp_path), "--seed", "3"])
    with pytest.raises(FileError, match=r"no run: config\.json is missing"):
        stored_config(tmp_path)


@pytest.mark.parametrize(
    "content", ["[]", '{"ppo": null}', '{"ppo": {"world": 3}}', '{"seeds": 1}']
)
def test_a_run_with_other_settings_is_refused_by_its_file(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(FileError, match=r"config\.json.*the settings of a run"):
        stored_config(tmp_path)


def test_a_number_of_worlds_is_not_replaced_by_what_fits(monkeypatch):
    monkeypatch.setattr(training_config, "has_gpu", lambda: True)
    assert parse(["--preset", "gpu"]).fit_memory
    for given in (["--ppo.worlds", "64"], ["--ppo.worlds=64"]):
        asked = parse(["--preset", "gpu", *given])
        assert asked.ppo.worlds == 64 and not asked.fit_memory
    with pytest.raises(InputError, match="--fit-memory"):
        parse(["--preset", "gpu", "--ppo.worlds", "64", "--fit-memory"])


def test_a_training_starts_from_its_own_states_and_is_judged_by_the_others(
    monkeypatch, tmp_path, robot, starts
):
    stored = load_handoffs(asset_path("handoffs_standins.npz"))
    names, seen = ("rubiks_cube", "apple"), {}
    scene = build_scene([handmade.box(name) for name in names], robot)
    world = World(scene, starts)  # starts of other objects: nothing begins from them
    keep = {
        "build_scene_of": lambda *_: scene,
        "build_world": lambda scene, states, task: seen.setdefault("training", states) and world,
        "evaluate_run": lambda *given: seen.setdefault("evaluation", given[3]),
    }
    monkeypatch.setattr(World, "task", lambda *_: None)
    keep["train_together"] = lambda members, *_: [None] * len(members)
    skipped = ("BraxTask", "init_state", "begin_from", "_save_policy")
    for name, instead in (keep | {name: lambda *_: None for name in skipped}).items():
        monkeypatch.setattr(job, name, instead)
    asked = replace(
        preset_config("cpu"),
        objects=names,
        handoffs=asset_path("handoffs_standins.npz"),
        out=tmp_path / "run",
    )
    run_training(asked, Console(quiet=True))
    places = {part: {tuple(p) for p in states.object_pos} for part, states in seen.items()}
    assert not places["training"] & places["evaluation"]
    assert len(seen["training"]) + len(seen["evaluation"]) == len(stored.select(names))


def refused(config, *, match):
    """A training that ends before there is a folder of its own."""
    with pytest.raises(MjxGraspError, match=match):
        run_training(replace(config, out=Path("run")), Console(quiet=True))
    assert not Path("run").exists()


def test_a_training_that_cannot_work_leaves_no_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(job, "build_scene_of", None)  # nothing long is begun
    config = preset_config("cpu")
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(b"PK")
    refused(replace(config, handoffs=damaged), match=r"damaged\.npz")
    bowl = replace(config, objects=("bowl",), handoffs=asset_path("handoffs_standins.npz"))
    refused(bowl, match="--objects: found 'bowl'")
    monkeypatch.setattr(job, "build_scene_of", lambda *_: None)
    monkeypatch.setitem(sys.modules, "wandb", None)
    project = replace(config, loop=LoopConfig(wandb_project="foo"))
    refused(project, match=r"--loop\.wandb-project.*mjx_grasp\[wandb\]")


def test_an_interrupted_run_says_how_to_continue(monkeypatch, scene):
    def interrupted(*_):
        raise KeyboardInterrupt("interrupted after iteration 3")

    monkeypatch.setattr(job, "build_scene_of", lambda *_: scene)
    monkeypatch.setattr(job, "made_handoffs", interrupted)
    config = replace(preset_config("cpu"), out=Path("a run"))
    expected = "iteration 3; continue with: python -m mjx_grasp.train --resume 'a run'"
    with pytest.raises(KeyboardInterrupt, match=expected):
        run_training(config, Console(quiet=True))


def test_help_of_the_preset_says_how_it_is_chosen(capsys, monkeypatch):
    monkeypatch.setattr(training_config, "has_gpu", lambda: False)
    with pytest.raises(SystemExit):
        parse(["--help"])
    said = " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
    assert "(default: auto)" in said
    assert parse([]).preset == "cpu"
