"""The runner without JAX: the same answers, and nothing of JAX in its process."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.learning.numpy_policy import NumpyPolicy
from mjx_grasp.learning.policy import load_policy

ROOT = Path(__file__).resolve().parents[2]
FRAMEWORKS = ("jax", "jaxlib", "brax", "flax", "mujoco", "warp", "scipy")

ALONE = f"""
import sys
import numpy as np
import mjx_grasp

policy = mjx_grasp.NumpyPolicy.load(sys.argv[1])
np.save(sys.argv[3], policy(np.load(sys.argv[2])))
loaded = [name for name in {FRAMEWORKS} if name in sys.modules]
assert not loaded, loaded
"""


@pytest.fixture(scope="module")
def shipped():
    return asset_path("policy.npz")


def observations(policy, spread, count=512):
    rng = np.random.default_rng(0)
    noise = spread * rng.standard_normal((count, policy.observation_size))
    return (policy.mean + policy.std * noise).astype(np.float32)


@pytest.mark.parametrize("spread", [0.3, 1.0, 10.0])
def test_numpy_answers_as_jax_does(shipped, spread):
    policy = NumpyPolicy.load(shipped)
    obs = observations(policy, spread)
    expected = np.asarray(jax.jit(load_policy(shipped))(obs))
    found = policy(obs)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert (np.abs(expected) < 1).any()


def test_a_batch_answers_as_each_of_it_does(shipped):
    policy = NumpyPolicy.load(shipped)
    obs = observations(policy, 1.0, 12)
    looped = np.stack([policy(single) for single in obs])
    np.testing.assert_allclose(policy(obs), looped, atol=1e-6)
    np.testing.assert_allclose(policy(obs.reshape(3, 4, -1)).reshape(12, -1), looped, atol=1e-6)


def test_answers_stay_within_one_without_warnings(shipped):
    policy = NumpyPolicy.load(shipped)
    with np.errstate(all="raise", under="ignore"):
        found = policy(observations(policy, 1e6))
    assert np.isin(np.abs(found), 1.0).mean() > 0.99 and np.abs(found).max() == 1.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_lost_reading_is_refused_and_not_answered_by_what_is_no_number(shipped, wrong):
    policy = NumpyPolicy.load(shipped)
    seen = observations(policy, 1.0)
    seen[0, 3] = wrong
    with pytest.raises(InputError, match="obs: found 'numbers that are not finite'"):
        policy(seen)


def test_the_mean_observation_goes_in_as_zeros(shipped):
    policy = NumpyPolicy.load(shipped)
    x = np.zeros(policy.observation_size)
    for w, b in zip(policy.weights[:-1], policy.biases[:-1], strict=True):
        x = x @ w + b
        x = np.where(x > 0, x, np.exp(x) - 1)
    expected = np.clip(x @ policy.weights[-1] + policy.biases[-1], -1, 1)
    np.testing.assert_allclose(policy(policy.mean), expected, atol=1e-5)


def test_a_process_that_runs_it_loads_no_jax(shipped, tmp_path):
    policy = load_policy(shipped)
    obs = observations(policy, 1.0)
    np.save(tmp_path / "obs.npy", obs)
    command = [sys.executable, "-c", ALONE, shipped, tmp_path / "obs.npy", tmp_path / "act.npy"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    np.testing.assert_allclose(
        np.load(tmp_path / "act.npy"), np.asarray(jax.jit(policy)(obs)), atol=1e-5
    )


@pytest.mark.wrong_types
def test_observations_of_another_size_are_refused(shipped):
    policy = NumpyPolicy.load(shipped)
    size = policy.observation_size
    for shape in ((size - 1,), (3, size + 1), ()):
        with pytest.raises(InputError, match=rf"obs: found 'shape .*expected {size} numbers last"):
            policy(np.zeros(shape))


def test_it_knows_robot_and_task(shipped):
    policy, same = NumpyPolicy.load(shipped), load_policy(shipped)
    assert policy.robot == same.robot
    assert json.dumps(policy.meta) == json.dumps(same.meta)
