"""Scripts that share their work: a killed run goes on, and two processes write what one does."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from on_cores import run_on_cores

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = ROOT / "experiments"
STANDINS = ROOT / "assets" / "handoffs_standins.npz"
FLAGS = {
    "heavy_objects": f"--objects foam_brick --handoffs {STANDINS} --episodes 2 --most 8 16 "
    "--finger-torque 1",
    "lift_stability": "--object foam_brick --seconds 4 --trials 2 --budgets 3 --impratios 1",
    "steered_grasps": "--objects pear",
}


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
