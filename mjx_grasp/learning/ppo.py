"""PPO from Brax's parts: its networks, loss, normaliser and rollout, in a resumable loop.

Brax 0.14.2's own `train()` calls `jax.device_put_replicated`, which JAX 0.10 no longer has (brax
issue 671), and cannot restore the optimiser (brax issue 655). The iteration below follows its
order of operations with the whole training state in one pytree.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import State
from brax.training import acting
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks
from brax.training.agents.ppo import optimizer as ppo_optimizer
from flax import linen
from jaxtyping import Array, Float, Int

from mjx_grasp.learning.brax_env import EPISODE_FIELDS, BraxTask
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.devices import Devices
from mjx_grasp.tasks.curriculum import Learnt


class TrainState(NamedTuple):
    """Everything a training needs to go on."""

    params: losses.PPONetworkParams
    policy: Any
    """the actor's weights as they are given away: see `PPOConfig.averaged`"""
    optimizer: optax.OptState
    normalizer: running_statistics.RunningStatisticsState
    env: State
    key: Array
    iteration: Array


SMALLEST_STD = 0.1
"""A flag that was always 0 must not become 10⁶ standard deviations when it is 1 for once."""

Metrics = dict[str, Float[Array, ""]]
_Carry = tuple[optax.OptState, losses.PPONetworkParams, Array]
"""What an update changes: optimiser, weights and key."""


def make_networks(config: PPOConfig, env: BraxTask) -> networks.PPONetworks:
    """Actor and critic; the critic reads `privileged_state` when the preset says so."""
    return networks.make_ppo_networks(
        env.observation_size,
        env.action_size,
        preprocess_observations_fn=running_statistics.normalize,
        policy_hidden_layer_sizes=config.hidden,
        value_hidden_layer_sizes=config.hidden,
        activation=linen.elu,
        policy_obs_key="state",
        value_obs_key="privileged_state" if config.privileged_critic else "state",
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=config.action_std,
        mean_kernel_init_fn=jax.nn.initializers.orthogonal,
        mean_kernel_init_kwargs={"scale": 0.01},
    )


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam with clipped gradients and a learning rate that the iteration may set."""
    adam = optax.inject_hyperparams(optax.adam)(learning_rate=config.learning_rate)
    return optax.chain(optax.clip_by_global_norm(config.gradient_norm), adam)


def init_state(config: PPOConfig, env: BraxTask, seed: int) -> TrainState:
    """A training that has not begun."""
    key, env_key, policy_key, value_key = jax.random.split(jax.random.PRNGKey(seed), 4)
    nets = make_networks(config, env)
    params = losses.PPONetworkParams(
        policy=nets.policy_network.init(policy_key), value=nets.value_network.init(value_key)
    )
    shapes = {n: specs.Array(s, jnp.dtype("float32")) for n, s in env.observation_size.items()}
    state = TrainState(
        params=params,
        policy=jax.tree.map(jnp.copy, params.policy),  # of its own: both may be donated
        optimizer=make_optimizer(config).init(params),
        normalizer=running_statistics.init_state(shapes),
        env=env.fresh(env_key),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )
    # Weakly typed leaves would make the second iteration compile anew.
    state = jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), state)
    return state._replace(**env.devices.common(learner_of(state)))


def learner_of(state: TrainState) -> dict[str, Any]:
    """All of a training but its worlds."""
    return {name: getattr(state, name) for name in TrainState._fields if name != "env"}


def make_iteration(
    config: PPOConfig, env: BraxTask
) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """One PPO iteration: a rollout, then epochs of minibatches. To be jitted by the caller.

    Every device rolls out its own worlds and takes minibatches of them; gradients, divergence,
    statistics and metrics are those of all.
    """
    devices = env.devices
    nets = make_networks(config, env)
    optimizer = make_optimizer(config)
    critic_first = round(config.critic_first * config.iterations)
    averaged = round(config.averaged * config.iterations)
    make_policy = networks.make_inference_fn(nets, compute_value=config.value_clip is not None)
    loss_and_gradient = jax.value_and_grad(
        functools.partial(
            losses.compute_ppo_loss,
            ppo_network=nets,
            entropy_cost=config.entropy,
            discounting=config.discount,
            reward_scaling=config.reward_scale,
            gae_lambda=config.gae_lambda,
            clipping_epsilon=config.clip,
            vf_coefficient=config.value_weight,
            clipping_epsilon_value=config.value_clip,
        ),
        has_aux=True,
    )

    def minibatch_step(
        carry: _Carry, data: Any, normalizer: Any, iteration: Int[Array, ""]
    ) -> tuple[_Carry, Metrics]:
        optimizer_state, params, key = carry
        key, loss_key = jax.random.split(key)
        (_, metrics), gradient = devices.mean(loss_and_gradient(params, normalizer, data, loss_key))
        if config.desired_kl is not None:
            optimizer_state, _ = ppo_optimizer.adaptive_kl_learning_rate(
                optimizer_state, metrics["kl_mean"], config.desired_kl
            )
        critic_alone = iteration < critic_first
        if config.tuning or critic_first:
            rates = optimizer_state[-1].hyperparams
            fixed = critic_alone | (iteration >= config.iterations - config.tuning)
            rates["learning_rate"] = jnp.where(fixed, config.learning_rate, rates["learning_rate"])
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        if critic_first:
            stays = jax.tree.map(lambda step: jnp.where(critic_alone, 0, step), updates.policy)
            updates = updates.replace(policy=stays)
        metrics["learning_rate"] = rate = optimizer_state[-1].hyperparams["learning_rate"]
        if config.critic_rate is not None:
            # Adam's step is proportional to its rate.
            ratio = config.critic_rate / rate
            updates = updates.replace(value=jax.tree.map(lambda step: ratio * step, updates.value))
        return (optimizer_state, optax.apply_updates(params, updates), key), metrics

    def epoch(
        carry: _Carry, _nothing: None, data: Any, normalizer: Any, iteration: Int[Array, ""]
    ) -> tuple[_Carry, dict[str, Float[Array, " minibatches"]]]:
        optimizer_state, params, key = carry
        key, order_key, step_key = jax.random.split(key, 3)
        order = jax.random.permutation(order_key, env.worlds)

        def shuffled(x: Array) -> Array:
            return x[order].reshape(config.minibatches, -1, *x.shape[1:])

        step: Any = functools.partial(minibatch_step, normalizer=normalizer, iteration=iteration)
        (optimizer_state, params, _), metrics = jax.lax.scan(
            step, (optimizer_state, params, step_key), jax.tree.map(shuffled, data)
        )
        return (optimizer_state, params, key), metrics

    def on_one(learner: Any, env_state: State) -> tuple[Any, State]:
        state = TrainState(**learner, env=env_state)
        key, rollout_key, sgd_key = jax.random.split(state.key, 3)
        policy = make_policy((state.normalizer, state.params.policy, state.params.value))
        env_state, data = acting.generate_unroll(
            env,
            state.env,
            policy,
            devices.own_key(rollout_key),
            config.unroll,
            extra_fields=EPISODE_FIELDS,
        )
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
        (optimizer_state, params, _), training = jax.lax.scan(
            functools.partial(
                epoch,
                data=data,
                normalizer=state.normalizer,
                iteration=state.iteration,
            ),
            (state.optimizer, state.params, sgd_key),
            length=config.epochs,
        )
        policy_params = params.policy
        if averaged:
            among = state.iteration + 1 - (config.iterations - averaged)
            policy_params = optax.incremental_update(
                params.policy, state.policy, 1.0 / jnp.maximum(among, 1)
            )
        # After the updates: the KL that adapts the learning rate compares with the old outputs.
        normalizer = running_statistics.update(
            state.normalizer,
            data.observation,
            std_min_value=SMALLEST_STD,
            pmap_axis_name=devices.axis,
        )
        metrics = _rollout_metrics(devices, data, env.task.reward_names)
        metrics |= jax.tree.map(jnp.mean, training)
        broken = jnp.sum(data.extras["state_extras"]["broken"])
        incident = devices.that_of_most(env_state.info["incident"], broken)
        env_state = env_state.replace(info=env_state.info | {"incident": incident})
        learnt = Learnt(
            share=(state.iteration + 1) / config.iterations,
            episodes=metrics["episodes"],
            successes=devices.sum(jnp.sum(data.extras["state_extras"]["episode_success"])),
        )
        env_state, said = env.paced(env_state, learnt)
        metrics |= said
        done = TrainState(
            params,
            policy_params,
            optimizer_state,
            normalizer,
            env_state,
            key,
            state.iteration + 1,
        )
        return (learner_of(done), metrics), env_state

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        (learner, metrics), env_state = devices.each(on_one)(learner_of(state), state.env)
        return TrainState(**learner, env=env_state), metrics

    return iterate


def reward_columns(names: Sequence[str]) -> dict[str, str]:
    """What the mean per step of each reward term is called in logs."""
    return {name: f"reward/{name}" for name in names}


def _rollout_metrics(devices: Devices, data: Any, reward_names: Sequence[str]) -> Metrics:
    """Sums and means over a rollout, episodes counted where they ended."""
    info = data.extras["state_extras"]
    episodes = devices.sum(jnp.sum(info["episode_done"]))
    count = jnp.maximum(episodes, 1.0)

    def total(name: str) -> Array:
        return devices.sum(jnp.sum(info[name]))

    def per_episode(name: str) -> Array:
        return jnp.where(episodes > 0, total(name) / count, jnp.nan)

    return {
        "reward": devices.mean(jnp.mean(data.reward)),
        "episodes": episodes,
        "return": per_episode("episode_reward"),
        "success": per_episode("episode_success"),
        "force_n": per_episode("episode_force"),
        "broken_worlds": total("broken"),
        "overflows": total("overflow"),
    } | {
        column: devices.mean(jnp.mean(info["reward_terms"][..., k]))
        for k, column in enumerate(reward_columns(reward_names).values())
    }
