"""The examples run as their first lines say, on less."""

import csv
import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tried_here():
    tried = {"own_mesh", "own_reward", "another_robot", "gym_training"}
    assert {path.stem for path in EXAMPLES.glob("*.py")} == tried


def test_a_mesh_of_ones_own_gets_points_low_and_high(capsys):
    example("own_mesh").main([])
    said = capsys.readouterr().out
    low, high = (
        float(line.split()[-5].strip("[]")) for line in said.splitlines() if "thumb" in line
    )
    assert 0 < low < 90 < high < 200, said  # mm above the bottle's foot


@pytest.mark.long
def test_a_reward_of_ones_own_is_logged_by_its_name(tmp_path):
    example("own_reward").main(tmp_path / "run", iterations=1, worlds=8)
    with (tmp_path / "run" / "metrics.csv").open() as stream:
        (row,) = csv.DictReader(stream)
    assert float(row["reward/gentle"]) <= 0.0 and (tmp_path / "run" / "policy.npz").is_file()


@pytest.mark.long
def test_another_robot_reaches(capsys):
    module = example("another_robot")
    outcome = module.main(EXAMPLES / "robot" / "six_axis.yaml", library_size=8000)
    assert outcome is module.ReachOutcome.HANDOFF, capsys.readouterr().out


@pytest.mark.long
def test_another_library_trains_a_policy_that_is_one_here(tmp_path, capsys):
    pytest.importorskip("skrl")
    example("gym_training").main(tmp_path, iterations=2, worlds=4)
    from mjx_grasp.learning.controller import load_controller
    from mjx_grasp.robot.spec import load_robot

    policy = load_controller(tmp_path / "policy.npz", load_robot())
    assert policy.meta["env_steps"] == 2 * 32 * 4
    assert (policy.std > 0).all() and np.ptp(policy.std) > 0, "no statistics were taken"
    assert any(np.abs(bias).max() > 0 for bias in policy.biases), "nothing was learnt"
