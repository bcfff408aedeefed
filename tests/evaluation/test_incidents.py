"""What an evaluation says of overflowing buffers and of worlds that stop being finite."""

import io
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.evaluation import run as module
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.job import evaluate_to_file
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.run import evaluate
from mjx_grasp.evaluation.trials import Trials, incidents
from mjx_grasp.sim import engines
from mjx_grasp.sim.mjx_engine import MjxPhysics
from mjx_grasp.tasks.assemble import TaskConfig, World


@pytest.fixture
def said(scene, starts, monkeypatch):
    """Evaluates the squeeze on the box in MJX for ten ticks: counts, and what the console shows."""

    def run(**buffers):
        monkeypatch.setattr(engines, "MjxPhysics", partial(MjxPhysics, **buffers))
        config = EvaluateConfig(
            out=Path("r.json"), controller="squeeze", engine="mjx", episodes=3, worlds=2
        )
        console = Console(file=io.StringIO(), width=200)
        world = World(scene, starts)
        task = TaskConfig(episode_s=0.1)
        rows, trials = evaluate(world, ["box"], config, None, np.zeros(9, bool), console, task)
        assert [row.object for row in rows] == ["box"]
        return trials["box"], console.file.getvalue()

    return run


@pytest.mark.long
def test_buffers_that_are_too_small_are_counted_and_warned_of(said):
    trials, text = said(constraints_per_world=8)
    assert trials.overflow_ticks.shape == (3,) and (trials.overflow_ticks > 0).all()
    assert (trials.overflow_ticks <= 10).all()
    total = incidents([trials])["overflows"]
    assert f"box: {total} buffer overflows in 3 of 3 trials" in text


def test_the_buffers_of_an_evaluation_hold_and_nothing_is_said(said):
    trials, text = said()
    assert incidents([trials]) == {"overflows": 0, "broken_worlds": 0}
    assert "overflow" not in text and "broken" not in text


def trials_of(n, overflow_ticks, broken):
    """Trials that never lifted anything."""
    none = np.zeros(n, bool)
    return Trials(
        row=np.zeros(n, np.int32),
        success=none,
        never_lifted=~none,
        slipped=none,
        not_held=none,
        broken=np.array(broken, bool),
        overflow_ticks=np.array(overflow_ticks),
        force_mean=np.full(n, np.nan),
        force_peak=np.full(n, np.nan),
        force_held=np.full(n, np.nan),
        peak_rise=np.zeros(n),
        reward=np.zeros(n),
    )


def test_a_row_tells_trial_by_trial_what_came_of_it():
    trials = trials_of(5, [0] * 5, [0] * 5)._replace(
        success=np.array([1, 0, 0, 1, 0], bool),
        never_lifted=np.array([0, 0, 1, 0, 0], bool),
        slipped=np.array([0, 1, 0, 0, 0], bool),
        not_held=np.array([0, 0, 0, 0, 1], bool),
    )
    row = module.summarise(
        "box",
        trials,
        EvaluateConfig(out=Path("r.json"), episodes=5),
        np.zeros(9, bool),
        TaskConfig(),
    )
    assert row.outcomes == "SPLSH"
    assert (row.successes, row.never_lifted, row.slipped, row.not_held) == (2, 1, 1, 1)


@pytest.mark.parametrize("field", ["force_mean", "force_peak", "force_held"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_broken_worlds_forces_spoil_no_row(tmp_path, field, bad):
    fine = trials_of(2, [0, 0], [0, 1])._replace(
        never_lifted=np.array([False, False]),
        success=np.array([True, True]),
        force_mean=np.array([2.0, 4.0]),
        force_peak=np.array([3.0, 5.0]),
        force_held=np.array([2.5, 4.5]),
    )
    trials = fine._replace(**{field: np.array([getattr(fine, field)[0], bad])})
    config = EvaluateConfig(out=tmp_path / "r.json", episodes=2)
    row = module.summarise("box", trials, config, np.zeros(9, bool), TaskConfig())
    json.dumps(asdict(row), allow_nan=False)
    whole = field == "force_held"  # the others say together whether a trial's force counts
    assert row.force_mean_n == (3.0 if whole else 2.0) and row.force_peak_n == (5 if whole else 3)
    assert row.force_held_n == (2.5 if whole else 3.5)


@pytest.mark.parametrize(
    ("overflow_ticks", "broken", "expected"),
    [
        ([0, 7, 5], [0, 1, 0], ["12 buffer overflows in 2 of 3 trials", "1 of 3 worlds broken"]),
        ([0, 0, 0], [0, 0, 0], []),
    ],
)
def test_the_command_warns_on_stderr_and_keeps_the_totals(
    tmp_path, monkeypatch, capsys, overflow_ticks, broken, expected
):
    monkeypatch.setenv("COLUMNS", "200")
    trials = trials_of(3, overflow_ticks, broken)
    monkeypatch.setattr(module, "run_trials", lambda *_: trials)
    out = tmp_path / "results.json"
    config = EvaluateConfig(out=out, controller="squeeze", objects=("foam_brick",), episodes=3)
    evaluate_to_file(config, Console(stderr=True))
    shown = capsys.readouterr()
    for text in expected:
        assert f"foam_brick: {text}" in shown.err
        assert text not in shown.out
    if not expected:
        assert "overflow" not in shown.err and "broken" not in shown.err
    extra = read_results(out).extra
    assert (extra["overflows"], extra["broken_worlds"]) == (sum(overflow_ticks), sum(broken))
