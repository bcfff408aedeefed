from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks
from forging import rewrite

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.policy import load_policy, policy_from_training
from mjx_grasp.learning.ppo import make_networks
from mjx_grasp.robot.identity import RobotIdentity

ROBOT = RobotIdentity("six_axis", "a1" * 32)


class Sizes(BraxTask):
    """All that the networks ask of an environment."""

    observation_size = {"state": (66,), "privileged_state": (120,)}  # noqa: RUF012
    action_size = 15

    def __init__(self):
        pass


@pytest.fixture(scope="module")
def trained():
    """Networks, parameters away from their small beginnings, and statistics of data."""
    nets = make_networks(PPOConfig(hidden=(16, 12)), Sizes())
    params = nets.policy_network.init(jax.random.PRNGKey(0))
    keys = iter(jax.random.split(jax.random.PRNGKey(1), 50))
    params = jax.tree.map(lambda x: x + 0.5 * jax.random.normal(next(keys), x.shape), params)
    shapes = {n: specs.Array(s, jnp.dtype("float32")) for n, s in Sizes.observation_size.items()}
    normalizer = running_statistics.init_state(shapes)
    data = {
        n: 2.0 + 3.0 * jax.random.normal(next(keys), (64, *s))
        for n, s in Sizes.observation_size.items()
    }
    return nets, params, running_statistics.update(normalizer, data), data["state"]


@pytest.fixture
def stored(trained, tmp_path):
    _, params, normalizer, _ = trained
    path = tmp_path / "policy.npz"
    meta = {"objects": ["box"], "task": {"a": 1}}
    policy_from_training(params, normalizer, meta, ROBOT).save(path)
    return path


def test_stored_policy_answers_as_brax_does(trained, stored):
    nets, params, normalizer, obs = trained
    act = networks.make_inference_fn(nets)((normalizer, params, None), deterministic=True)
    expected, _ = act({"state": obs, "privileged_state": jnp.zeros((64, 120))}, None)
    policy = load_policy(stored)
    found = policy(obs)
    assert (np.abs(expected) > 1).any() and (np.abs(expected) < 1).any()
    # The environment clips; the file does so itself.
    np.testing.assert_allclose(found, np.clip(expected, -1, 1), atol=2e-5)
    np.testing.assert_allclose(jax.jit(policy)(obs[3]), found[3], atol=1e-5)
    assert (policy.observation_size, policy.action_size) == (66, 15)
    assert policy.meta == {"objects": ["box"], "task": {"a": 1}}
    assert policy.robot == ROBOT


def test_saving_again_changes_nothing(stored, tmp_path):
    policy = load_policy(stored)
    policy.save(tmp_path / "again.npz")
    again = load_policy(tmp_path / "again.npz")
    for a, b in zip(policy.weights + policy.biases, again.weights + again.biases, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("place", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_damaged_file_is_refused_by_name(stored, place):
    content = bytearray(stored.read_bytes())
    at = int(place * len(content))
    content[at : at + 8] = bytes(b ^ 0xFF for b in content[at : at + 8])
    stored.write_bytes(bytes(content))
    with pytest.raises(FileError, match=r"policy\.npz"):
        load_policy(stored)


def test_truncated_foreign_and_missing_files_are_refused(stored, tmp_path):
    content = stored.read_bytes()
    stored.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileError, match=r"policy\.npz"):
        load_policy(stored)
    for name, write in (
        ("text.npz", lambda p: p.write_text("hello")),
        ("empty.npz", lambda p: p.write_bytes(b"")),
        ("other.npz", lambda p: np.savez(p, header=np.frombuffer(b'{"format": "x"}', np.uint8))),
        ("list.npz", lambda p: np.savez(p, header=np.frombuffer(b"[1, 2]", np.uint8))),
        ("bare.npz", lambda p: np.savez(p, a=np.ones(3))),
    ):
        write(tmp_path / name)
        with pytest.raises(FileError, match=name.replace(".", r"\.")):
            load_policy(tmp_path / name)
    with pytest.raises(FileError, match="no such file"):
        load_policy(tmp_path / "nowhere.npz")


def test_header_is_checked_as_well_as_the_arrays(stored):
    """A changed task in the header would evaluate the policy in another task than it learned."""
    rewrite(stored, lambda arrays, header: header["meta"]["task"].update(a=2))
    with pytest.raises(FileError, match=r"policy\.npz.*checksum"):
        load_policy(stored)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.update(mean=arrays["mean"][1:]), r"std float32 \(66,\)"),
        (lambda arrays: arrays.update(std=0 * arrays["std"]), "std with zeros"),
        (lambda arrays: arrays.update(std=np.nan * arrays["std"]), "not finite"),
        (lambda arrays: arrays.update(bias_1=arrays["bias_1"][1:]), "layers of shapes"),
        (lambda arrays: arrays.pop("bias_1"), "no array 'bias_1'"),
        (lambda arrays: arrays.update(weight_7=arrays.pop("weight_1")), "no array 'weight_1'"),
        (lambda arrays: arrays.update(bias_3=arrays["bias_2"]), "layers of shapes"),
        (lambda arrays: arrays.update(weight_0=arrays["weight_0"][0]), "weight_0 float32"),
    ],
)
def test_layers_that_do_not_fit_are_refused_with_a_right_checksum(stored, change, message):
    rewrite(stored, lambda arrays, header: change(arrays), sign=True)
    with pytest.raises(FileError, match=message):
        load_policy(stored)


def test_layers_that_do_not_fit_are_not_written(stored, tmp_path):
    policy = load_policy(stored)
    with pytest.raises(FileError, match="layers of shapes"):
        replace(policy, biases=policy.biases[::-1]).save(tmp_path / "new.npz")
    assert not (tmp_path / "new.npz").exists()


def test_networks_of_another_kind_are_refused(trained):
    with pytest.raises(InputError, match="policy_params"):
        policy_from_training({"params": {"Conv_0": {}}}, trained[2], {}, ROBOT)
