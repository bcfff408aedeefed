"""A training that begins with a policy does at first what the policy does."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_training as tiny
from brax.training.agents.ppo import networks

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.learned import KeepingConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.policy import Policy, load_policy
from mjx_grasp.learning.ppo import init_state, make_iteration, make_networks
from mjx_grasp.learning.warm_start import begin_from
from mjx_grasp.training.config import settings_of
from mjx_grasp.training.start import start_file, start_policy

STEPS = 10**10
"""More than 32 bits hold."""


@pytest.fixture(scope="module")
def env():
    return tiny.make_env()


@pytest.fixture(scope="module")
def policy(env):
    """Layers by chance."""
    rng, sizes = np.random.default_rng(0), (*env.observation_size["state"], 8, 8, env.action_size)
    weights = [rng.normal(size=s).astype(np.float32) / 8 for s in pairwise(sizes)]
    biases = [rng.normal(size=n).astype(np.float32) / 8 for n in sizes[1:]]
    mean, std = rng.normal(size=sizes[0]), rng.uniform(0.5, 2.0, sizes[0])
    numbers = mean.astype(np.float32), std.astype(np.float32)
    return Policy(*numbers, tuple(weights), tuple(biases), {"env_steps": STEPS})


@pytest.fixture(scope="module")
def begun(env, policy):
    config = tiny.ppo()
    return begin_from(policy, config, env, init_state(config, env, seed=0))


def answers(env, state, obs):
    """The mean of what the actor does."""
    act = networks.make_inference_fn(make_networks(tiny.ppo(), env))
    known = state.normalizer, state.params.policy, state.params.value
    return act(known, deterministic=True)(obs, jax.random.PRNGKey(0))[0]


def test_the_actor_is_the_policy(env, policy, begun):
    obs = env.reset(jax.random.PRNGKey(1)).obs
    wanted = policy(obs["state"])
    np.testing.assert_allclose(answers(env, begun, obs).clip(-1, 1), wanted, atol=1e-6)
    for given, taken in zip(
        *map(jax.tree.leaves, (begun.policy, begun.params.policy)), strict=True
    ):
        np.testing.assert_array_equal(given, taken)


def test_all_else_is_that_of_a_training_that_begins(env, begun):
    fresh = init_state(tiny.ppo(), env, seed=0)
    assert jax.tree.structure(begun) == jax.tree.structure(fresh)
    for a, b in zip(jax.tree.leaves(begun), jax.tree.leaves(fresh), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
    for name in ("optimizer", "env", "key", "iteration"):
        jax.tree.map(np.testing.assert_array_equal, getattr(begun, name), getattr(fresh, name))
    widths = (s.params.policy["params"]["std_logparam"]["log_value"] for s in (begun, fresh))
    np.testing.assert_array_equal(*widths)


@pytest.mark.long
def test_the_actors_observations_keep_their_scale_and_the_critics_get_one(env, policy, begun):
    statistics = begun.normalizer
    assert int(statistics.count.to_numpy()) == STEPS
    np.testing.assert_array_equal(statistics.mean["state"], policy.mean)
    np.testing.assert_array_equal(statistics.std["state"], policy.std)
    assert jnp.abs(statistics.mean["privileged_state"]).max() > 0
    after = jax.jit(make_iteration(tiny.ppo(), env))(begun)[0].normalizer
    assert int(after.count.to_numpy()) == STEPS + tiny.ppo().steps_per_iteration
    for name in statistics.mean:  # a handful of new steps among as many
        np.testing.assert_allclose(after.mean[name], statistics.mean[name], atol=1e-3)
        np.testing.assert_allclose(after.std[name], statistics.std[name], rtol=1e-3)


def test_layers_of_another_size_are_refused(env, policy):
    config = replace(tiny.ppo(), hidden=(8, 4))
    with pytest.raises(InputError, match="layers of"):
        begin_from(policy, config, env, init_state(config, env, seed=0))


def test_the_shipped_policy_fits_the_presets_that_feel(robot):
    for preset in ("cpu", "gpu"):
        config = replace(settings_of(preset), start_from="shipped")
        assert start_policy(config, robot).meta == load_policy(asset_path("policy.npz")).meta
        seen = replace(config.task.observation, keeping=KeepingConfig(gain=7.0))
        other = replace(config, task=replace(config.task, observation=seen))
        assert start_policy(other, robot) is not None, "how it is held to a budget may differ"
    nothing = replace(settings_of("gpu"), start_from=None)
    assert start_policy(nothing, robot) is None and start_file(nothing) is None


@pytest.mark.parametrize("preset", ["cpu", "gpu", "paper", "end-to-end"])
def test_a_preset_that_begins_with_a_policy_lets_the_critic_learn_first(preset):
    """A policy's file has no critic: what one that knows nothing says would undo the actor."""
    config = settings_of(preset)
    alone = round(config.ppo.critic_first * config.ppo.iterations)
    assert (alone > 0) == (config.start_from is not None)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"ppo.hidden": (64, 64)}, "ppo.hidden"),
        ({"task.observation.budget": False}, "task.observation"),
        ({"task.action.limit": 0.1}, "task.action"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(robot, changes, text):
    ((path, value),) = changes.items()
    config = replace(settings_of("gpu"), start_from="shipped")
    *owners, last = path.split(".")

    def changed(settings, names):
        if not names:
            return replace(settings, **{last: value})
        inner = getattr(settings, names[0])
        return replace(settings, **{names[0]: changed(inner, names[1:])})

    with pytest.raises(InputError, match=rf"--start-from: found .*policy.npz with {text}"):
        start_policy(changed(config, owners), robot)


def test_a_missing_file_is_refused_by_name(robot):
    with pytest.raises(FileError, match=r"no\.npz"):
        start_policy(replace(settings_of("gpu"), start_from="no.npz"), robot)
