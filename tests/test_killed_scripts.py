"""Scripts that are killed go on; two processes that share the work write what one does."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import handmade
import numpy as np
import pytest
from loaded import script
from on_cores import run_on_cores

from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import write_json
from mjx_grasp.training.config import settings_of

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = ROOT / "experiments"
STANDINS = ROOT / "assets" / "handoffs_standins.npz"
FLAGS = {
    "heavy_objects": f"--objects foam_brick --handoffs {STANDINS} --episodes 2 --most 8 16 "
    "--finger-torque 1",
    "lift_stability": "--object foam_brick --seconds 4 --trials 2 --budgets 3 --impratios 1",
    "steered_grasps": "--objects pear",
}
OUT, PICTURE = Path("out.json"), Path("out.png")
"""in the working directory"""


def heavy_objects(module, folder):
    config = module.HeavyConfig(
        out=folder / "out.json",
        objects=("foam_brick",),
        handoffs=STANDINS,
        finger_torque=(1.0, 2.0),
    )
    return config, module.Grips, "rows", lambda job: [{"job": list(job)}]


def lift_stability(module, folder):
    config = module.StabilityConfig(
        out=folder / "out.json", picture=folder / "out.png", object="foam_brick", impratios=(1.0,)
    )
    curves = [np.ones((50, 2)), np.ones((50, 2, 3)), np.ones((50, 2)), np.ones((50, 2))]
    shown = [values.tolist() for values in curves]
    return config, module.Holds, "hold", lambda job: {"rows": [{"job": list(job)}], "curves": shown}


def steered_grasps(module, folder):
    config = module.SteeredConfig(out=folder / "out.json", objects=("pear",))
    return config, module.Steered, "rows", lambda job: [{"job": job}]


@pytest.mark.parametrize("case", [heavy_objects, lift_stability, steered_grasps])
def test_a_killed_run_loses_nothing_that_was_finished(case, tmp_path, monkeypatch, committed):
    """Nor does a run of other settings take it for its own."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    module = importlib.import_module(case.__name__)
    config, own, method, result = case(module, tmp_path)
    done, most = [], 1

    def work(self, job):
        if len(done) == most:
            raise KeyboardInterrupt
        done.append(job)
        return result(job)

    monkeypatch.setattr(own, method, work)
    with pytest.raises(KeyboardInterrupt):
        module.main(config)
    assert not config.out.exists(), "only what is whole is a result"
    most = -1
    module.main(config)
    assert len(done) == len(set(done)) > 1, "none twice"
    rows = json.loads(config.out.read_text())["rows"]
    assert [row["job"] for row in rows] == json.loads(json.dumps(done))
    assert {path.name for path in tmp_path.iterdir()} <= {"out.json", "out.png"}

    jobs, most = len(done), len(done) + 1
    with pytest.raises(KeyboardInterrupt):
        module.main(config)
    most = -1
    module.main(replace(config, seed=7))
    assert len(done) == jobs + 1 + jobs


def boxes(name, _):
    """Of a size of its own for each name."""
    return handmade.box(half=(0.03, 0.02, 0.02 + 0.001 * len(name))).mesh


def eligibility(monkeypatch):
    module = script("eligibility")
    groups = {"train": ("apple", "mug"), "held_out": ("banana",), "eight": ("mug", "pear")}
    monkeypatch.setattr(module, "resolve", lambda names: sum((groups[n] for n in names), ()))
    monkeypatch.setattr(module, "DIFFICULT", ("mug",))
    names = ("published", "opposition 0.7", "default: both")
    monkeypatch.setattr(module, "SETTINGS", {name: module.SETTINGS[name] for name in names})
    monkeypatch.setattr(module, "object_mesh", boxes)
    return module, module.EligibilityConfig(out=OUT), "compute_heatmaps", 3


def heatmap_figure(monkeypatch):
    module = script("heatmap_figure")
    monkeypatch.setattr(module, "object_mesh", boxes)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: 1.5))
    config = module.FigureConfig(
        objects=("mug", "apple", "banana"), cell_pixels=60, out=PICTURE, results=OUT
    )
    return module, config, "compute_heatmap", 3


def steered_trials_figure(monkeypatch):
    module, film = script("steered_trials_figure"), {}

    def run_demo(demo, console):
        success = demo.seed == 1
        film[demo.out / "grasp.mp4"] = np.random.default_rng(demo.seed).integers(
            0, 255, (60, 48, 64, 3), np.uint8
        )
        found = {"object": demo.object, "mesh": "scan", "asked": f"“{demo.instruction}” (part)"}
        found |= {"from_anchor_mm": 12.3, "at_best_mm": 9.1, "success": success}
        phases = [{"name": "reaching", "start": 0.0, "end": 1.1}]
        grasp = {"outcome": "success" if success else "not_held"}
        return found | {"phases": phases, "grasp": grasp}

    monkeypatch.setattr(module, "check_films", lambda: None)
    monkeypatch.setattr(module, "run_demo", run_demo)
    monkeypatch.setattr(module.iio, "imiter", lambda path: iter(film[path]))
    monkeypatch.setattr(module, "CASES", (("mug", "by the handle"), ("wine_glass", "by the stem")))
    return module, module.TrialsConfig(cell_pixels=64, out=PICTURE, results=OUT), "run_demo", 4


def policy_ablation(monkeypatch):
    """Of two runs with the same task: a batch of trials of each, and two squeezes."""
    module, runs = script("policy_ablation"), (Path("a"), Path("b"))
    for run in runs:
        run.mkdir()
        (run / "policy.npz").write_text(run.name)
        write_json(run / "provenance.json", {"command": run.name})
    for name in ("load_robot", "load_handoffs", "build_scene_of", "states_of", "build_world"):
        monkeypatch.setattr(module, name, lambda *_, **__: SimpleNamespace(object_names=()))
    monkeypatch.setattr(module, "eligible", lambda *_: ((), ()))
    monkeypatch.setattr(module, "stored_config", lambda folder: settings_of("paper"))
    monkeypatch.setattr(module, "policy_task", lambda policy: "a policy's")
    policy = SimpleNamespace
    monkeypatch.setattr(module, "load_policy", lambda path: policy(controller=lambda: f"{path}"))

    def tried(world, task, controller, noises, felt, config):
        return [{"by": controller, "task": str(task), "noise": str(noise)} for noise in noises]

    monkeypatch.setattr(module, "_tried", tried)
    config = module.AblationConfig(runs, out=OUT, budgets=(2.0, 3.0), squeezes=(1.0, 3.0))
    return module, config, "_tried", 4


ONE_PROCESS = (eligibility, heatmap_figure, policy_ablation, steered_trials_figure)


@pytest.mark.parametrize("case", ONE_PROCESS)
def test_what_is_made_one_after_the_other_is_made_once(case, tmp_path, monkeypatch, committed):
    """However often it is killed, and what comes of it is what comes of a run that is not."""
    monkeypatch.syspath_prepend(EXPERIMENTS)

    def made(folder, at_a_time):
        """The files of runs that are killed after so many jobs, until one is not."""
        folder.mkdir()
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            module, config, name, jobs = case(patch)
            work, done, left = getattr(module, name), 0, 0

            def counted(*given):
                nonlocal done, left
                if left == 0:
                    raise KeyboardInterrupt
                done, left = done + 1, left - 1
                return work(*given)

            patch.setattr(module, name, counted)
            for _ in range(jobs):
                left = at_a_time
                try:
                    module.main(config)
                except KeyboardInterrupt:
                    continue
                break
        assert done == jobs, "none twice"
        return {path.name: path.read_bytes() for path in folder.glob("*out*")}

    whole = made(tmp_path / "whole", at_a_time=100)
    assert "out.json" in whole and ".out.json.begun" not in whole
    assert made(tmp_path / "killed", at_a_time=1) == whole


@pytest.mark.long
@pytest.mark.parametrize("name", FLAGS)
def test_two_processes_write_what_one_does(name, tmp_path):
    """A core each."""
    found = []
    for n in (1, 2):
        command = [sys.executable, EXPERIMENTS / f"{name}.py", *FLAGS[name].split()]
        command += ["--processes", n, "--out", tmp_path / f"{n}.json"]
        command += ["--picture", tmp_path / f"{n}.png"] if name == "lift_stability" else []
        run_on_cores(command, n)
        found.append(json.loads((tmp_path / f"{n}.json").read_text())["rows"])
    assert found[0] == found[1] and found[0]
    pictures = [path.read_bytes() for path in tmp_path.glob("*.png")]
    assert len(set(pictures)) <= 1


@pytest.mark.parametrize(
    ("name", "config", "more"),
    [
        ("pose_error", "PoseErrorConfig", {}),
        ("sensitivity", "SensitivityConfig", {}),
        ("policy_ablation", "AblationConfig", {"runs": (Path("none"),)}),
    ],
)
def test_another_file_is_not_written_over(tmp_path, monkeypatch, name, config, more):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    module, out = script(name), tmp_path / "mine.json"
    out.write_text('{"a": 1}')
    with pytest.raises(InputError, match=r"--out: found .*mine\.json, which is another file"):
        module.main(getattr(module, config)(out=out, **more))
    assert out.read_text() == '{"a": 1}'
