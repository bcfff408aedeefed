"""The examples run as their first lines say, on less."""

import csv
import importlib.util
from pathlib import Path

import numpy as np
import pytest

import mjx_grasp
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.robot.spec import load_robot

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tried_here():
    tried = {"own_mesh", "own_reward", "another_robot", "gym_training", "replayed_robot"}
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


def test_a_replayed_robot_measures_what_is_in_the_log_and_keeps_what_it_is_sent(tmp_path):
    module, spec = example("replayed_robot"), load_robot()
    rng, log = np.random.default_rng(0), module.Log()
    joints, sensed = len(spec.joints), sum(len(finger.joints) for finger in spec.hand.fingers)
    for _ in range(3):
        q, qd, target = rng.uniform(-0.1, 0.1, (3, joints)).astype(np.float32)
        read = module.of_joints(spec)(q, qd, rng.normal(size=(5, sensed)).astype(np.float32))
        pose = rng.normal(size=3).astype(np.float32), np.eye(3, dtype=np.float32)
        touching = rng.random(3) < 0.5
        log.add(read, mjx_grasp.Seen(*pose, touching, np.zeros((0, 4), np.float32)), target)
    log.save(tmp_path / "log.npz")
    robot = module.ReplayedRobot(module.Log.load(tmp_path / "log.npz"), spec)
    assert not robot.is_connected
    robot.connect()
    for period, target in enumerate(log.target):
        for name, kept in zip(module.READ, log.read[period], strict=True):
            np.testing.assert_array_equal(getattr(robot.read(), name), kept)
        np.testing.assert_array_equal(robot.look().p_wo, log.seen[period][0])
        np.testing.assert_array_equal(robot.look().touching, log.seen[period][2])
        robot.command(target + 1.0)
    np.testing.assert_array_equal(robot.sent, np.stack(log.target) + 1.0)


@pytest.mark.long
def test_a_replayed_grasp_is_commanded_as_it_was_and_otherwise_where_the_log_is_otherwise(tmp_path):
    module, path = example("replayed_robot"), tmp_path / "log.npz"
    assert module.main(path) == (Phase.LIFTING, 0.0)
    before = path.read_bytes()
    assert module.main(path) == (Phase.LIFTING, 0.0) and path.read_bytes() == before
    log = module.Log.load(path)
    log.seen = [(p_wo, R_wo, np.zeros(3, bool)) for p_wo, R_wo, _ in log.seen]
    log.read = [(q, qd, np.zeros_like(torque)) for q, qd, torque in log.read]
    log.save(path)
    phase, apart = module.main(path)
    assert phase is Phase.CLOSING and apart > 0.01, "nothing is felt, so nothing is lifted"
