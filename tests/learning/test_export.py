"""A policy as ONNX: the same answers, what a driver needs, refusals before anything long."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forging import rewrite
from six_axis import write_six_axis
from typed import refusal
from typed import typed as type_in

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.grasps.run import loaded_policy
from mjx_grasp.learning import export
from mjx_grasp.learning.controller import deployed_task, load_controller, policy_task
from mjx_grasp.learning.driver_facts import _finite, budget_facts, joint_facts
from mjx_grasp.learning.export import ExportConfig, export_policy, trial_observations
from mjx_grasp.learning.numpy_policy import NumpyPolicy
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.records.settings import from_record, to_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig
from mjx_grasp.tasks.layout import Segment, observation_layout
from mjx_grasp.tasks.observation import policy_sizes

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("jax2onnx")
SHIPPED = asset_path("policy.npz")


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    """The command as a user types it: the file, and what was printed."""
    out = tmp_path_factory.mktemp("export") / "policy.onnx"
    done = type_in("export", SHIPPED, "--out", out)
    assert (done.returncode, done.stderr) == (0, "")
    assert [p.name for p in out.parent.iterdir()] == ["policy.onnx"]
    return out, done.stdout


@pytest.fixture(scope="module")
def session(typed):
    return onnxruntime.InferenceSession(typed[0], providers=["CPUExecutionProvider"])


def ask(session, obs):
    return session.run(["action"], {"observation": np.asarray(obs, np.float32)})[0]


def facts(session):
    return {k: json.loads(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}


def test_the_command_says_how_well_the_file_agrees(typed):
    path, said = typed
    difference = float(said.split("difference from JAX: ")[1].split(",")[0])
    assert 0.0 <= difference <= 1e-5
    assert f"written: {path}" in said


def test_onnx_numpy_and_jax_agree(session):
    policy = load_policy(SHIPPED)
    obs = trial_observations(policy)
    expected = np.asarray(jax.jit(policy)(jnp.asarray(obs)))
    assert (np.abs(expected) == 1).any() and (np.abs(expected) < 1).any()
    np.testing.assert_allclose(ask(session, obs), expected, atol=1e-5)
    np.testing.assert_allclose(NumpyPolicy.load(SHIPPED)(obs), expected, atol=1e-5)


def test_the_extremes_are_among_what_both_are_asked():
    """Each number alone far above and below its mean, all of them at once, and the mean."""
    policy = load_policy(SHIPPED)
    steps = (trial_observations(policy) - policy.mean) / policy.std
    size, far = policy.observation_size, np.abs(np.abs(steps) - 10.0) < 0.01
    alone = np.round(steps[(far.sum(axis=1) == 1) & (np.abs(steps).sum(axis=1) < 10.1)])
    found = {(int(np.abs(row).argmax()), row.sum()) for row in alone}
    assert found == {(k, sign * 10.0) for k in range(size) for sign in (1, -1)}
    assert len(np.unique(np.sign(steps[far.all(axis=1)]), axis=0)) > 1
    assert (np.abs(steps) < 0.01).all(axis=1).any()


def test_a_batch_of_any_size_answers_as_each_of_it_does(session):
    obs = trial_observations(load_policy(SHIPPED))[:7]
    singly = np.concatenate([ask(session, single[None]) for single in obs])
    np.testing.assert_allclose(ask(session, obs), singly, atol=1e-6)
    assert ask(session, obs[:0]).shape == (0, 16)


def test_normaliser_and_clipping_are_inside(session):
    policy = load_policy(SHIPPED)
    far = policy.mean + 1e6 * policy.std * np.random.default_rng(1).choice([-1, 1], (64, 83))
    found = ask(session, far)
    assert np.abs(found).max() == 1.0 and (np.abs(found) == 1.0).mean() > 0.99
    unscaled = replace(policy, mean=0 * policy.mean, std=0 * policy.std + 1)
    np.testing.assert_allclose(
        ask(session, policy.mean[None]), unscaled(jnp.zeros((1, 83))), atol=1e-5
    )


def test_the_graph_has_the_names_that_are_promised(session):
    ((given,), (answered,)) = session.get_inputs(), session.get_outputs()
    assert (given.name, given.shape, given.type) == ("observation", ["batch", 83], "tensor(float)")
    assert (answered.name, answered.shape) == ("action", ["batch", 16])


def test_a_driver_finds_what_it_needs(session, robot):
    said, policy = facts(session), load_policy(SHIPPED)
    task = deployed_task(policy)
    assert said["format"] == {"name": "mjx_grasp policy export", "version": 1}
    assert said["robot"] == {"name": robot.name, "digest": robot.digest}
    assert [joint["name"] for joint in said["joints"]] == list(robot.joints)
    assert said["observed_joints"] == list(robot.hand.policy_joints)
    assert said["acted_joints"] == [*robot.hand.policy_joints, *robot.arm.policy_joints]
    assert said["control"] == {"period_s": 0.01, "rate_hz": 100.0}
    assert from_record(ClosingTaskConfig, said["task"]) == task
    layout = tuple(from_record(Segment, part) for part in said["observation"]["segments"])
    assert layout == observation_layout(robot, task)
    assert said["action"]["limits"] == [-1.0, 1.0] and said["action"]["law"] == to_record(
        task.action
    )
    assert said["force_budget"]["range_n"] == policy.meta["noise"]["budget_n"]
    assert said["policy"]["provenance"] == policy.meta["provenance"]
    assert len(said["policy"]["sha256"]) == 64 and said["exported"]["versions"]["jax"]


def test_gains_are_those_of_the_mjcf(robot):
    by_name = {joint["name"]: joint for joint in joint_facts(robot)}
    finger, arm = by_name["finger_r_joint2"], by_name["joint1"]
    assert (finger["kp_n_m_per_rad"], finger["kv_n_m_s_per_rad"]) == (3.0, 0.1)
    assert finger["torque_limit_n_m"] == [-0.6, 0.6]
    assert (arm["kp_n_m_per_rad"], arm["kv_n_m_s_per_rad"]) == (3000.0, 200.0)
    assert arm["position_limit_rad"] == pytest.approx([-2.8798, 2.8798])


def test_what_has_no_limit_is_null(tmp_path):
    (joint, *_) = joint_facts(load_robot(write_six_axis(tmp_path)))
    assert joint["torque_limit_n_m"] is None
    infinite = {"task": {"within": float("inf"), "terms": (1.0, float("-inf"))}}
    assert _finite(infinite) == {"task": {"within": None, "terms": [1.0, None]}}
    task = EndToEndConfig()
    assert math.isinf(task.within) and _finite(to_record(task))["within"] is None


def test_the_range_of_budgets_is_the_trainings_own_where_it_says_so(robot):
    policy = load_policy(SHIPPED)
    layout = observation_layout(robot, policy_task(policy))
    noise = {"noise": {"budget_n": [2.0, 7.0]}}
    assert budget_facts(replace(policy, meta=noise), layout)["range_n"] == [2.0, 7.0]
    assert budget_facts(policy, layout[:-1]) is None


def test_a_file_that_answers_otherwise_is_not_put_in_place(tmp_path, monkeypatch):
    """Its bias is off by little more than what is allowed."""
    model_of = export.onnx_model

    def other(policy, said):
        *first, last = policy.biases
        return model_of(replace(policy, biases=(*first, last + 1.5e-5)), said)

    monkeypatch.setattr(export, "onnx_model", other)
    (tmp_path / "old.onnx").write_text("old")
    with pytest.raises(FileError, match="differ by up to"):
        export_policy(ExportConfig(policy=SHIPPED, out=tmp_path / "old.onnx"))
    assert [p.name for p in tmp_path.iterdir()] == ["old.onnx"]
    assert (tmp_path / "old.onnx").read_text() == "old"


def misses(monkeypatch, package):
    """As if a package were not installed."""
    monkeypatch.setitem(sys.modules, package, None)


@pytest.mark.parametrize("package", ["jax2onnx", "onnx", "onnxruntime"])
def test_what_is_not_installed_is_named_with_its_extra(package, monkeypatch, capsys):
    misses(monkeypatch, package)
    status, said = refusal(monkeypatch, capsys, "export", SHIPPED, "--out", "new.onnx")
    assert status == 2
    assert f"no {package}" in said and "pip install 'mjx_grasp[export]'" in said


def test_another_task_than_is_known_here_is_refused(tmp_path, monkeypatch, capsys):
    path = tmp_path / "foreign.npz"
    path.write_bytes(SHIPPED.read_bytes())
    rewrite(path, lambda _, header: header["meta"]["task"].update(juggling=2), sign=True)
    status, said = refusal(monkeypatch, capsys, "export", path, "--out", "new.onnx")
    assert status == 2 and "foreign.npz" in said and "juggling" in said


def test_a_policy_that_reads_what_no_robot_knows_is_refused(tmp_path, monkeypatch, capsys, robot):
    policy, path = load_policy(SHIPPED), tmp_path / "told.npz"
    task = policy_task(policy)
    task = replace(task, observation=replace(task.observation, truth=True))
    more = policy_sizes(robot, task)[0] - policy.observation_size
    told = replace(
        policy,
        mean=np.pad(policy.mean, (0, more)),
        std=np.pad(policy.std, (0, more), constant_values=1.0),
        weights=(np.pad(policy.weights[0], ((0, more), (0, 0))), *policy.weights[1:]),
        meta=policy.meta | {"task": to_record(task)},
    )
    told.save(path)
    assert load_controller(path, robot).observation_size > policy.observation_size
    status, said = refusal(monkeypatch, capsys, "export", path, "--out", "new.onnx")
    assert status == 2 and "told.npz" in said and "observation.truth" in said
    with pytest.raises(FileError, match=r"told\.npz"):
        loaded_policy(robot, path)


def test_a_policy_of_another_robot_is_refused(tmp_path_factory, monkeypatch, capsys):
    other = write_six_axis(tmp_path_factory.mktemp("robot"))
    arguments = SHIPPED, "--out", "new.onnx", "--robot", other
    status, said = refusal(monkeypatch, capsys, "export", *arguments)
    assert status == 2 and "rizon4_hx5d20" in said and "six_axis" in said
    assert list(Path().iterdir()) == []
