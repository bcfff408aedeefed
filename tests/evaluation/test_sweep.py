"""The reach sweep: its distribution, what it records, and the command as a user types it."""

import io
import json
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest
from rich.console import Console
from typed import refusal

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.reach import run as module
from mjx_grasp.evaluation.reach.poses import TUNING_SEEDS, PoseDistribution, SweepConfig, draw_poses
from mjx_grasp.evaluation.reach.record import BUDGETS, TOLERANCES, empty_record, share_converged
from mjx_grasp.evaluation.reach.results import (
    FAILURES,
    PAPER_RATE,
    classify,
    held_up_by,
    summary,
)
from mjx_grasp.evaluation.reach.run import Reached, journal_of, run_sweep
from mjx_grasp.reaching.config import LimitConfig
from mjx_grasp.reaching.presets import PRESETS, for_sweep, reach_preset
from mjx_grasp.robot.spec import load_robot


def test_poses_are_of_the_distribution():
    poses, d = draw_poses(2752, seed=0), PoseDistribution()
    assert np.mean(poses.lying) == 0.5
    for values, (low, high) in (
        (poses.radius, d.radius),
        (2 * poses.half_length, d.height),
        (poses.p_wo[:, 0], d.x),
        (poses.p_wo[:, 1], d.y),
    ):
        assert low <= values.min() < values.max() <= high + 1e-6
        # Uniform: mean and spread of the range.
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
        assert values.std() == pytest.approx((high - low) / np.sqrt(12), rel=0.05)
    axis = poses.R_wo[:, :, 2]
    np.testing.assert_allclose(np.abs(axis[~poses.lying][:, 2]), 1.0, atol=1e-6)
    np.testing.assert_allclose(axis[poses.lying][:, 2], 0.0, atol=1e-6)
    lowest = np.where(poses.lying, poses.radius, poses.half_length)
    np.testing.assert_allclose(poses.p_wo[:, 2], lowest, atol=1e-6)
    identity = np.einsum("nij,nkj->nik", poses.R_wo, poses.R_wo)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-6)
    assert np.linalg.det(poses.R_wo) == pytest.approx(1.0)


def test_a_longer_draw_begins_with_the_shorter():
    short, long = draw_poses(10, seed=3), draw_poses(100, seed=3)
    for a, b in zip(short, long, strict=True):
        np.testing.assert_array_equal(a, b[:10])
    assert not np.allclose(short.p_wo, draw_poses(10, seed=4).p_wo)


def test_reported_seed_was_not_tuned_on():
    assert SweepConfig().seed not in TUNING_SEEDS


def test_rates_count_first_convergence():
    time = np.full((4, len(TOLERANCES)), np.inf)
    time[0] = 0.4
    time[1, 2:] = 2.9
    rates = share_converged(time)
    assert rates["10"] == {"0.5": 25, "1": 25, "2": 25, "3": 25, "5": 25, "7": 25}
    assert rates["20"]["2"] == 25 and rates["20"]["3"] == 50
    assert list(rates) == list(PAPER_RATE)
    assert all(len(row) == len(BUDGETS) for row in PAPER_RATE.values())


def _records(body, count):
    record = empty_record(len(body.lower))
    stacked = type(record)(*(np.repeat(np.asarray(leaf)[None], count, axis=0) for leaf in record))
    middle = 0.5 * (body.lower + body.upper)
    return stacked._replace(
        q=np.tile(middle, (count, 1)),
        ticks=np.ones(count, int),
    )


def test_failures_are_classed(body):
    record = _records(body, 6)
    record.fine_time[0] = 1.0  # converged
    record.fine_time[2] = 4.0  # slow
    least = np.full(6, 0.001)
    least[1] = 0.05  # no posture
    record.last_table[3] = 0.0005  # against the table
    record.q[4, 2] = body.upper[2] - 0.05  # at a limit
    names = [FAILURES[k] if k >= 0 else None for k in classify(body, LimitConfig(), record, least)]
    assert names == [None, "unreachable", "slow", "collision", "limit", "local minimum"]
    against = held_up_by(body, LimitConfig(), record)
    assert {name: np.flatnonzero(by).tolist() for name, by in against.items()} == {
        "joint limit": [4],
        "object": [],
        "table": [3],
        "finger": [],
    }


def test_summary_is_json_with_what_the_tables_show(body):
    record = _records(body, 8)
    record.fine_time[:6] = 2.0
    record.clock[:6] = 3.0
    record.near[:] = [0.5, 0.5, 0.5, -0.5, -0.5, -0.5, 0.5, np.inf]
    record.handoff_time[:6] = 2.5
    record.handoff_error[:6] = 0.004
    record.handoff_contact[:6] = 0.03
    record.handoff_midpoint[:6] = 0.003
    record.start_distance[:] = [0.05, 0.05, 0.05, 0.05, 0.05, 0.004, -0.01, -0.02]
    record.object_distance[:] = [0.02, 0.0095, 0.0085, 0.02, 0.02, 0.003, 0.001, np.inf]
    record.speed_ratio[:5] = 0.9
    record.speed_ratio[5:] = 1.0
    record.infeasible[7] = 3
    result = summary(body, LimitConfig(), draw_poses(8, 0), record, np.full(8, 0.002))
    text = json.loads(json.dumps(result))
    assert text["rate_percent"]["20"]["3"] == 75.0
    assert text["rate_percent_since_first_near"]["20"]["3"] == 37.5
    assert text["rate_percent_of_solvable"]["20"]["3"] == 75.0
    assert text["solvable_percent"]["10"] == 100.0
    assert text["handoff_mm"]["index"]["median"] == pytest.approx(4.0)
    assert sum(text["failures_percent"].values()) == pytest.approx(25.0)
    worst = text["limits"]
    assert [worst[k]["reaches"] for k in ("all", "safe", "near", "in_contact")] == [8, 5, 1, 2]
    assert worst["safe"]["least_object_distance_mm"] == pytest.approx(8.5)
    assert worst["safe"]["reaches_nearer_than_asked"] == 2
    assert worst["near"]["least_object_distance_mm"] == pytest.approx(3.0)
    assert worst["near"]["most_object_distance_lost_mm"] == pytest.approx(1.0)
    assert worst["safe"]["most_object_distance_lost_mm"] == pytest.approx(1.5)
    assert worst["in_contact"]["most_object_distance_lost_mm"] == 0.0
    assert worst["in_contact"]["deepest_start_mm"] == pytest.approx(20.0)
    assert worst["safe"]["deepest_start_mm"] == 0.0
    assert worst["in_contact"]["least_object_distance_mm"] == pytest.approx(1.0)
    assert worst["safe"]["largest_speed_over_limit"] == pytest.approx(0.9)
    assert worst["all"]["largest_speed_over_limit"] == pytest.approx(1.0)
    assert worst["all"]["ticks_infeasible"] == worst["in_contact"]["ticks_infeasible"] == 3
    # Nothing is said of reaches that there are not.
    empty = summary(body, LimitConfig(), draw_poses(6, 0), _records(body, 6), None)["limits"]
    assert empty["near"]["reaches"] == 0 and empty["near"]["least_object_distance_mm"] is None


def test_presets_add_one_thing_after_another():
    assert next(iter(PRESETS)) == "paper" and list(PRESETS)[-1] == "default"
    assert reach_preset("paper").plan is None and reach_preset("default").plan is not None
    assert len({repr(p) for p in PRESETS.values()}) == len(PRESETS)
    ended = for_sweep(reach_preset("paper")).reach.controller
    assert (ended.fine_timeout, ended.timeout, ended.reselect_late) == (7.0, 15.0, False)
    sooner = for_sweep(reach_preset("paper"), fine_timeout=3.0, timeout=6.0).reach.controller
    assert sooner == replace(ended, fine_timeout=3.0, timeout=6.0)
    with pytest.raises(InputError, match="preset"):
        reach_preset("fast")


def test_a_killed_sweep_loses_no_poses_that_were_finished(body, tmp_path, monkeypatch, committed):
    """And gives what it gives without a journal; another sweep does not take them for its own."""
    done, deadly, said = [], [4], io.StringIO()

    def share(self, rows):
        if rows.start in deadly:
            raise KeyboardInterrupt
        done.append(rows.start)
        record = _records(body, rows.stop - rows.start)
        number = np.arange(rows.start, rows.stop)
        record = type(record)(*((leaf.T + number).T.astype(leaf.dtype) for leaf in record))
        return Reached(record, 0.01 * number, {"planning": 0.3, "reaching": 0.1 + 0.2})

    monkeypatch.setattr(module.Reaching, "__init__", lambda self, *_: None)
    monkeypatch.setattr(module.Reaching, "share", share)
    robot, settings = load_robot(), reach_preset("straight")

    def swept(config, robot=robot):
        with journal_of(config, robot, Console(file=said)) as journal:
            return run_sweep(robot, settings, config.poses, config.seed, chunk=2, journal=journal)

    config = SweepConfig(poses=7, seed=9, out=tmp_path / "sweep.json")
    with pytest.raises(KeyboardInterrupt):
        swept(config)
    deadly.clear()
    assert said.getvalue() == ""
    run = swept(config)
    assert "goes on after poses 0 to 2, poses 2 to 4" in " ".join(said.getvalue().split())
    assert done == [0, 2, 4, 6] and list(tmp_path.iterdir()) == []
    whole = run_sweep(robot, settings, 7, 9, chunk=2)
    for ours, theirs in zip(run.record, whole.record, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    assert run.result.pop("seconds") == {"planning": 1.2, "reaching": 1.2}, "of all four shares"
    del whole.result["seconds"]
    assert json.dumps(run.result) == json.dumps(whole.result)

    others = (
        (replace(config, seed=10), robot),
        (config, replace(robot, name="another")),
        (config, robot),  # on another device
    )
    for other, reaches in others:
        deadly.append(4)
        with pytest.raises(KeyboardInterrupt):
            swept(config)
        deadly.clear()
        done.clear()
        if (other, reaches) == (config, robot):
            monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        swept(other, reaches)
        assert done == [0, 2, 4, 6]
    with journal_of(SweepConfig(), robot, Console()) as journal:
        assert journal is None, "nothing is written, nothing kept"


def _command(*args, cwd):
    call = [sys.executable, "-m", "mjx_grasp.sweep_reach", *args]
    return subprocess.run(call, capture_output=True, text=True, cwd=cwd, check=False)


@pytest.mark.long
def test_command_as_typed(tmp_path):
    out, plot = tmp_path / "sweep.json", tmp_path / "sweep.png"
    done = _command(
        *("--poses", "4", "--seed", "9", "--preset", "paper", "--no-bound"),
        *("--out", str(out), "--plot", str(plot)),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert "published" in done.stdout and "tolerance" in done.stdout
    result = json.loads(out.read_text())
    assert result["poses"] == 4 and result["provenance"]["seed"] == 9
    assert set(result["rate_percent"]) == {"10", "15", "20", "30", "50"}
    worst = result["limits"]["all"]
    assert worst["reaches"] == 4
    assert worst["largest_speed_over_limit"] <= 1.0 + 1e-5
    assert worst["farthest_beyond_joint_limit_rad"] == 0.0
    # Half-spaces of the nearest points alone give a little.
    assert result["limits"]["safe"]["least_object_distance_mm"] > 9.0
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_a_refusal_has_no_traceback_in_the_shell(tmp_path):
    done = _command("--poses", "0", cwd=tmp_path)
    assert done.returncode == 2
    assert "poses" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "args",
    [
        ("--poses", "0"),
        ("--out", "x.txt"),
        ("--preset", "fast"),
        ("--chunk", "-1"),
        ("--seed", "-1"),
    ],
)
def test_wrong_settings_are_refused(args, monkeypatch, capsys):
    status, error = refusal(monkeypatch, capsys, "sweep_reach", *args)
    assert status == 2
    assert args[0].removeprefix("--") in error and "expected" in error


def test_a_file_that_holds_no_sweep_is_not_replaced(tmp_path, monkeypatch, capsys):
    other = tmp_path / "grasps.json"
    other.write_text('{"schema": "mjx_grasp.scenarios/1"}')
    status, error = refusal(monkeypatch, capsys, "sweep_reach", "--out", str(other))
    assert status == 2 and "another file (mjx_grasp.scenarios/1)" in " ".join(error.split())
    assert other.read_text() == '{"schema": "mjx_grasp.scenarios/1"}'
