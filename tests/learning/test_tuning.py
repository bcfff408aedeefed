"""Many trainings by one plan: which they are, how they go on, what their table says."""

import csv
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import write_json
from mjx_grasp.training import tuning
from mjx_grasp.training.plan import Run, as_flags, read_plan
from mjx_grasp.training.plan_table import gathered, shown
from mjx_grasp.training.tuning import TuneConfig, run_all, tune

PLAN = """
flags: {preset: cpu, ppo.iterations: 2}
settings:
  usual:
  blind: {task.observation.forces: false, ppo.hidden: [8, 8]}
objects: {cube: [rubiks_cube], two: [rubiks_cube, foam_brick]}
seeds: [0, 3]
"""


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(PLAN)
    return path


def test_every_combination_is_a_training(plan):
    runs = read_plan(plan)
    assert len({run.name for run in runs}) == len(runs) == 2 * 2 * 2
    (blind,) = [run for run in runs if run.name == "blind-two-seed3"]
    assert (blind.setting, blind.objects, blind.seed) == ("blind", "two", 3)
    words = " ".join(blind.flags)
    assert words.startswith("--preset cpu --ppo.iterations 2 ")
    for flag in ("--task.observation.no-forces", "--ppo.hidden 8 8", "--seed 3"):
        assert flag in words
    more = read_plan(plan, "--objects-dir 'my scans'")
    assert [run.flags for run in more] == [(*r.flags, "--objects-dir", "my scans") for r in runs]
    for wrong in ("--seed 5", "--objects mug", "--ppo.iterations=3"):
        with pytest.raises(InputError, match=r"--flags: .*not the plan's"):
            read_plan(plan, wrong)
    with pytest.raises(InputError, match=r"--flags: .*No closing quotation"):
        read_plan(plan, "--objects-dir 'my")
    assert words.endswith("--objects rubiks_cube foam_brick")
    assert "forces" not in " ".join(runs[0].flags)


def test_values_become_words_of_a_command_line():
    values = {"a_b": 1, "c.d_e": True, "c.f": False, "g": [0.5, 2], "h": "x"}
    assert " ".join(as_flags(values)) == "--a-b 1 --c.d-e --c.no-f --g 0.5 2 --h x"


@pytest.mark.parametrize(
    "text",
    [
        "seeds: [0]", "settings: {a: {}}", "settings: {a: {}}\nseeds: [0, 0]", "[1, 2]", "{a: :",
        "settings: {a: {}}\nseeds: [0]\nepisodes: 3", "settings: {a: {}}\nseeds: [x]",
        "settings: {a: {}}\nseeds: [0]\nobjects: {cups: mug}", "settings: {a: {}}\nseeds: '01'",
        "", "settings: [a]\nseeds: [0]", "settings: {a: preset}\nseeds: [0]",
        "settings: {a: {}}\nseeds: [1.7]", "settings: {a: {}}\nseeds: [true]",
        "settings: {a: {seed: 5}}\nseeds: [0]", "settings: {a: {out: x}}\nseeds: [0]",
        "settings: {a: {}, a: {preset: gpu}}\nseeds: [0]", "settings: {../a: {}}\nseeds: [0]",
        "settings: {a: {objects-dir: x, objects_dir: y}}\nseeds: [0]",
        "flags: {objects: [mug]}\nsettings: {a: {}}\nseeds: [0]\nobjects: {cups: [mug]}",
    ],
)  # fmt: skip
def test_what_is_no_plan_is_refused(tmp_path, text):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=r"plan\.yaml.*no plan") as error:
        read_plan(path)
    assert "object" not in str(error.value).replace("objects", "")  # as in 'NoneType' object


def test_two_trainings_of_the_same_name_are_refused(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("settings: {a: {}, a-b: {}}\nobjects: {b-c: [cup], c: [bowl]}\nseeds: [0]")
    with pytest.raises(FileError, match=r"plan\.yaml: found 2 trainings with the name a-b-c-seed0"):
        read_plan(path)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("{ppo.worlds: 3}", r"a-seed0: .*worlds"),
        ("{no.such.flag: 3}", r"a-seed0: .*no\.such"),
        ("{robot: nobody}", r"a-seed0: .*nobody"),
        ("{start_from: none.npz}", r"a-seed0: none\.npz: found no such file"),
        ("{ppo.hidden: [8, 8]}", r"a-seed0: --start-from: .*ppo\.hidden"),
        ("{objects: [muug]}", r"a-seed0: object: found 'muug'"),
        ("{objects_dir: none}", r"a-seed0: none: found no such folder"),
        ("{handoffs: none.npz}", r"a-seed0: none\.npz: found no such file"),
        (
            f"{{handoffs: {asset_path('handoffs_standins.npz')}, objects: [power_drill]}}",
            r"a-seed0: --objects: found 'power_drill', expected objects with pre-grasps",
        ),
    ],
)
def test_what_train_would_refuse_is_refused_before_anything_starts(tmp_path, setting, said, capfd):
    path, out = tmp_path / "plan.yaml", tmp_path / "out"
    path.write_text(f"flags: {{preset: cpu}}\nsettings: {{a: {setting}}}\nseeds: [0]")
    with pytest.raises(FileError, match=said):
        tune(TuneConfig(path, out), Console(quiet=True))
    assert not list(out.glob("*"))


@pytest.fixture
def started(monkeypatch):
    """The names of the trainings that would have been run, instead of them."""
    names = []

    def run_none(config, runs, console):
        names.extend(run.name for run in runs)
        return {}

    monkeypatch.setattr(tuning, "run_all", run_none)
    return names


def written(folder, *, command=None, flags=None):
    """A folder of a training that was begun by a command, and ended with flags if there are any."""
    if flags is not None:
        metrics(folder, 0.5, 2.0)
        write_json(folder / "finished.json", {"flags": flags.split()})
    if command is not None:
        write_json(folder / "provenance.json", {"command": command})


NEW = "--preset cpu --seed 0 --ppo.iterations 3"
OLD = "--preset cpu --seed 0 --ppo.iterations 2"
TRAIN = "python -m mjx_grasp.train"
BY_RAY = "python default_worker.py --node 1"


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        (f"{TRAIN} {OLD} --out x", None),
        (f"{TRAIN} {OLD} --out x", OLD),
        (f"{TRAIN} {OLD} --out x", NEW),
        (BY_RAY, OLD),
        (None, OLD),
    ],
    ids=["unfinished", "finished", "went on under another plan", "by Ray", "flags alone"],
)
def test_what_was_begun_with_other_flags_is_refused(tmp_path, started, command, flags):
    path, out = tmp_path / "plan.yaml", tmp_path / "out"
    path.write_text("flags: {preset: cpu, ppo.iterations: 3}\nsettings: {a: }\nseeds: [0, 1]")
    written(out / "a-seed0", command=command, flags=flags)
    said = r"a-seed0: found .* --ppo\.iterations 2, expected --ppo\.iterations 3, .*another --out"
    with pytest.raises(FileError, match=said):
        tune(TuneConfig(path, out), Console(quiet=True))
    assert not started and not (out / "table.json").exists()


@pytest.mark.parametrize(
    ("command", "flags", "goes_on"),
    [
        (f"{TRAIN} {NEW} --out 'a b'", None, True),
        (f"{TRAIN} {NEW} --out x", NEW, False),
        (BY_RAY, NEW, False),
        (None, NEW, False),
    ],
)
def test_what_was_begun_with_the_same_flags_counts(tmp_path, started, command, flags, goes_on):
    """In whatever order; of a folder that was never opened nothing is known."""
    path, out = tmp_path / "plan.yaml", tmp_path / "out"
    path.write_text("flags: {preset: cpu}\nsettings: {a: {ppo.iterations: 3}}\nseeds: [0, 1]")
    written(out / "a-seed0", command=command, flags=flags)
    write_json(out / "a-seed1" / "config.json", {})
    tune(TuneConfig(path, out), Console(quiet=True))
    assert started == (["a-seed0"] if goes_on else []) + ["a-seed1"]


def test_a_training_keeps_with_what_flags_it_was_begun(tmp_path, started, monkeypatch):
    path, out = tmp_path / "plan.yaml", tmp_path / "out"
    path.write_text("flags: {preset: cpu, ppo.hidden: [512, 256]}\nsettings: {a: }\nseeds: [0]")

    def open_runs(configs, console, commands):
        write_json(configs[0].out / "provenance.json", {"command": commands[0]})
        raise KeyboardInterrupt

    monkeypatch.setattr(tuning, "run_together", open_runs)
    (run,) = read_plan(path)
    with pytest.raises(KeyboardInterrupt):
        tuning.train([str(out / run.name)], [list(run.flags)], os.getcwd())
    monkeypatch.setattr(tuning, "refusals", lambda trainings, cwd: [""])
    tune(TuneConfig(path, out), Console(quiet=True))
    assert started == ["a-seed0"]
    path.write_text(path.read_text().replace("256", "128"))
    with pytest.raises(FileError, match=r"--ppo\.hidden 512 256, expected --ppo\.hidden 512 128"):
        tune(TuneConfig(path, out), Console(quiet=True))


@pytest.mark.long
def test_a_cluster_is_asked_for_its_gpus_and_its_workers_do_not_take_all_of_one(
    tmp_path, monkeypatch
):
    cluster_utils = pytest.importorskip("ray.cluster_utils")

    def checked(trainings, cwd):
        import ray

        return [f"asked on GPU {ray.get_gpu_ids()}"] * len(trainings)

    def say(folders, flags, cwd):
        import ray

        share = os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE")
        Path(folders[0]).write_text(f"{share} {ray.get_gpu_ids()} {os.environ['PYTHONPATH']}")

    monkeypatch.delenv("XLA_PYTHON_CLIENT_PREALLOCATE", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(tuning, "has_gpu", lambda: False)
    monkeypatch.setattr(tuning, "refusals", checked)
    cluster = cluster_utils.Cluster(True, head_node_args={"num_cpus": 1, "num_gpus": 1})
    try:
        path = tmp_path / "plan.yaml"
        path.write_text("settings: {a: }\nseeds: [0]")
        config = TuneConfig(path, tmp_path, address=cluster.address)
        with pytest.raises(FileError, match=r"a-seed0: asked on GPU \[0\]"):
            tune(config, Console(quiet=True))
        assert not run_all(config, read_plan(path), Console(quiet=True), say)
    finally:
        cluster.shutdown()
    assert (tmp_path / "a-seed0").read_text().startswith(f"false [0] {tmp_path}")


def test_without_ray_it_says_what_to_install(plan, monkeypatch):
    monkeypatch.setattr(tuning, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"mjx_grasp\[ray\]"):
        tune(TuneConfig(plan, Path("out")), Console(quiet=True))


@pytest.fixture
def trainings(monkeypatch):
    """What `train` would have run, instead of it."""
    asked = []
    monkeypatch.setattr(tuning, "parse", lambda argv: argv)

    def ask(argvs, console, commands):
        asked.extend(zip(argvs, commands, strict=True))

    monkeypatch.setattr(tuning, "run_together", ask)
    return asked


def test_a_training_begins_goes_on_or_is_left_alone(tmp_path, trainings):
    """What was cut short while it was opened begins anew."""
    folder, cwd = tmp_path / "run", os.getcwd()

    def train():
        tuning.train([str(folder)], [["--seed", "1"]], cwd)

    folder.mkdir()
    (folder / "config.json").touch()
    (tmp_path / "run" / "handoffs.npz").touch()
    (tmp_path / "run" / "start.npz").touch()
    train()
    argv, command = trainings.pop()
    assert argv == ["--seed", "1", "--out", str(folder)]
    said = shlex.split(command)
    assert said[:-1] == ["python", "-m", "mjx_grasp.train", "--seed", "1", "--out"]
    assert Path(said[-1]).resolve() == folder and not Path(said[-1]).is_absolute()
    assert [p.name for p in folder.iterdir()] == ["finished.json"]
    shutil.rmtree(folder)
    folder.mkdir()
    (folder / "provenance.json").touch()
    train()
    assert [argv for argv, _ in trainings] == [["--resume", str(folder)]]
    train()
    assert len(trainings) == 1, "it is finished"


def test_a_folder_that_holds_something_else_stays(tmp_path, trainings):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileError, match=r"notes\.txt and no training"):
        tuning.train([str(tmp_path)], [["--seed", "1"]], os.getcwd())
    assert not trainings and (tmp_path / "notes.txt").read_text() == "mine"


def test_seeds_that_are_trained_together_are_one_process(tmp_path, trainings, monkeypatch):
    """All of a setting that are left; those that were cut short in their opening begin anew."""
    runs = [Run(f"{s}-seed{k}", s, "", k, ("--seed", str(k))) for s in "ab" for k in (0, 1)]
    config = TuneConfig(tmp_path / "plan.yaml", tmp_path, together=True)
    assert [[r.name for r in group] for group in tuning._groups(config, runs)] == [
        ["a-seed0", "a-seed1"],
        ["b-seed0", "b-seed1"],
    ]
    alone = tuning._groups(replace(config, together=False), runs)
    assert [len(group) for group in alone] == [1, 1, 1, 1]
    folders = [tmp_path / run.name for run in runs[:3]]
    for folder in folders:
        folder.mkdir()
    (folders[0] / "finished.json").touch()
    (folders[1] / "provenance.json").touch()

    def train():
        tuning.train(list(map(str, folders)), [list(r.flags) for r in runs[:3]], os.getcwd())
        asked = [argv for argv, _ in trainings]
        trainings.clear()
        return asked

    begun, new = ["--resume", str(folders[1])], ["--seed", "0", "--out", str(folders[2])]
    assert train() == [begun, new], "what has begun goes on, apart from what has not"
    for folder in folders[1:]:
        (folder / "finished.json").unlink()
        folder.mkdir(exist_ok=True)
        (folder / "provenance.json").touch()
    assert train() == [["--resume", str(folder)] for folder in folders[1:]]
    assert train() == [] and all((f / "finished.json").exists() for f in folders)


def test_seeds_together_need_start_states(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("settings: {a: {preset: cpu, handoffs-per-object: 8}}\nseeds: [0, 1]")
    with pytest.raises(InputError, match="--together: found 'a without --handoffs'"):
        tune(TuneConfig(path, tmp_path / "out", together=True), Console(quiet=True))
    assert not (tmp_path / "out").exists()


def metrics(folder, success, force):
    folder.mkdir(parents=True)
    with (folder / "metrics.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("iteration", "seconds", "success", "force_n"))
        writer.writerows((i + 1, 10.0 * i, success, force) for i in range(30))
    write_json(folder / "finished.json", {})


def test_the_table_has_means_over_seeds_of_what_is_finished(tmp_path, plan):
    runs = [run for run in read_plan(plan) if run.objects == "cube"]
    for run, success in zip(runs[:3], (0.5, 0.7, 0.9), strict=True):
        metrics(tmp_path / run.name, success, float("nan") if run.seed else 2.0)
    rows = gathered(tmp_path, runs)
    assert [row["trained_percent"] for row in rows] == pytest.approx([50, 70, 90])
    assert [row["trained_force_n"] for row in rows] == [2.0, None, 2.0]
    console = Console(width=120)
    with console.capture() as capture:
        console.print(shown(rows))
    _, usual, blind = capture.get().strip().splitlines()
    assert usual.split()[:4] == ["usual", "cube", "2", "60.0"] and "(50.0–70.0)" in usual
    assert blind.split()[:5] == ["blind", "cube", "1", "90.0", "2.0"]


@pytest.mark.long
def test_lost_workers_cost_no_result_and_make_none_twice(tmp_path):
    """More than twenty are killed at random; one training fails by itself."""
    (tmp_path / "pids").mkdir()

    def write_slowly(folders, flags, cwd):
        """Stands for a training: says who does it, takes a while, then writes its result."""
        at = Path(folders[0])
        at.mkdir(parents=True, exist_ok=True)
        (at.parent / "pids" / f"{os.getpid()}").touch()
        time.sleep(0.6)
        if flags == [["fail"]]:
            raise ValueError("cannot work")
        with (at / "done").open("a") as stream:
            stream.write("x")

    runs = [Run(f"run{k}", "a", "", k, ("fail",) if k == 5 else ()) for k in range(12)]
    rng, killed, started = random.Random(0), set(), time.monotonic()
    over = threading.Event()

    def kill_some():
        while not over.is_set() and len(killed) < 24:
            pids = {int(p.name) for p in (tmp_path / "pids").iterdir()} - killed
            for pid in pids:
                if rng.random() < 0.8:
                    try:
                        os.kill(pid, signal.SIGKILL)
                        killed.add(pid)
                    except ProcessLookupError:
                        killed.add(-pid)
            time.sleep(0.05)

    thread = threading.Thread(target=kill_some)
    thread.start()
    config = TuneConfig(tmp_path / "plan.yaml", tmp_path, gpus=0.0, cpus=0.5)
    try:
        failed = run_all(config, runs, Console(quiet=True), write_slowly)
    finally:
        over.set()
        thread.join()
    assert sum(pid > 0 for pid in killed) >= 20
    assert list(failed) == ["run5"] and "cannot work" in failed["run5"]
    for run in runs:
        done = tmp_path / run.name / "done"
        assert done.exists() is (run.name != "run5")
        assert run.name == "run5" or done.read_text() == "x"
    assert time.monotonic() - started < 280


@pytest.mark.parametrize("content", ['{"took_s": 3, "mine": 1}', None])
def test_what_lies_where_a_plan_would_write_is_refused_before_anything_starts(tmp_path, content):
    plan, out = tmp_path / "plan.yaml", tmp_path / "out"
    plan.write_text("settings: {tiny: {}}\nseeds: [0]")
    if content is None:
        out.write_text("mine")
    else:
        out.mkdir()
        (out / "table.json").write_text(content)
    with pytest.raises((InputError, FileError), match=r"a folder to which|schema"):
        tune(TuneConfig(plan, out), Console(quiet=True))


@pytest.mark.long
def test_a_plan_is_trained_as_a_user_types_it(tmp_path):
    """Two seeds of a tiny training; the second call runs nothing."""
    path, out = tmp_path / "plan.yaml", tmp_path / "out"
    path.write_text(
        "flags: {preset: cpu, ppo.iterations: 2, ppo.worlds: 8, ppo.unroll: 4, "
        "handoffs_per_object: 4, evaluation_episodes: 0}\nsettings: {tiny: {}}\nseeds: [0, 1]"
    )
    command = [sys.executable, "-m", "mjx_grasp.tune", str(path), "--out", str(out)]
    took = []
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == 0, done.stderr
        table = json.loads((out / "table.json").read_text())
        took.append(table["took_s"])
    assert 1.0 < took[0] <= took[1] < took[0] + 1.0
    assert table["plan"]["seeds"] == [0, 1]
    made = json.loads((out / "tiny-seed1" / "provenance.json").read_text())
    assert made["command"].startswith("python -m mjx_grasp.train --preset cpu")
    assert [row["seed"] for row in table["rows"]] == [0, 1]
    assert np.isfinite([row["seconds"] for row in table["rows"]]).all()
    assert {p.name for p in out.iterdir()} == {"tiny-seed0", "tiny-seed1", "table.json"}
