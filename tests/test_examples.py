"""The examples run as their first lines say, on less."""

import csv
import importlib.util
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import mjx_grasp
from mjx_grasp.errors import FileError
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
    low, high = heights(capsys.readouterr().out)
    assert 0 < low < 90 < high < 200  # mm above the bottle's foot


def heights(said):
    """Of the thumb's contacts [mm]."""
    contacts = re.findall(r"thumb +at \[(.*)\] mm", said)
    return [float(contact.split()[2]) for contact in contacts]


def test_a_mesh_from_a_file_stands_on_the_table_and_gets_points_low_and_high(tmp_path, capsys):
    path = tmp_path / "carton.stl"
    trimesh.creation.box((0.06, 0.06, 0.15)).export(path)
    example("own_mesh").main([str(path)])
    low, high = heights(capsys.readouterr().out)
    assert -75 < low < 0 < high < 75  # mm from its middle


@pytest.mark.long
def test_where_no_finger_fits_above_the_table_the_example_says_so(tmp_path, capsys):
    path = tmp_path / "plate.stl"
    trimesh.creation.box((0.06, 0.06, 0.012)).export(path)
    example("own_mesh").main([str(path)])
    assert capsys.readouterr().out.count("at least 15 mm above the table") == 2


@pytest.mark.parametrize("name", ["own_reward", "gym_training"])
def test_examples_without_a_folder_say_how_they_are_called(name, monkeypatch):
    if name == "gym_training":
        pytest.importorskip("skrl")
    monkeypatch.setattr(sys, "argv", [name])
    with pytest.raises(SystemExit, match=rf"python examples/{name}\.py FOLDER"):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


@pytest.mark.parametrize(
    ("name", "content"), [("box.stl", b"solid"), ("box.npz", b"solid"), ("box.npz", b"")]
)
def test_a_log_that_is_none_is_refused_by_its_name(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileError, match=rf"{name}.* expected .*\.npz"):
        example("replayed_robot").main(path)
    assert path.read_bytes() == content


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
