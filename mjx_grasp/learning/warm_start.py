"""A training that goes on from a policy instead of from nothing."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training import acting
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks
from brax.training.types import UInt64

from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.policy import Policy, actor_of
from mjx_grasp.learning.ppo import SMALLEST_STD, TrainState, learner_of, make_networks


def begin_from(policy: Policy, config: PPOConfig, env: BraxTask, state: TrainState) -> TrainState:
    """A training with a policy's actor; its critic knows nothing yet (see `critic_first`).

    The actor's observations are normalised as in the policy's own training, as if seen for as many
    steps; the critic's by one rollout of the policy.

    Args:
        policy: The policy, of the task that `env` has.
        config: Settings of the training.
        env: Its worlds.
        state: The training that has not begun.

    Raises:
        InputError: The policy's layers have other sizes than the training's.
    """
    devices = env.devices
    make_policy = networks.make_inference_fn(make_networks(config, env))
    own = {"mean": jnp.asarray(policy.mean), "std": jnp.asarray(policy.std)}
    actor, own = devices.common((actor_of(policy, state.params.policy), own))

    def knowing(statistics: Any, own: Any, **fields: Any) -> Any:
        """Of the actor's observations what the policy knows."""
        known = {name: getattr(statistics, name) | {"state": x} for name, x in own.items()}
        return statistics.replace(**known, **fields)

    def on_one(given: Any, worlds: State) -> tuple[Any, State]:
        learner, actor, own = given
        act = make_policy((knowing(learner["normalizer"], own), actor, learner["params"].value))
        key = devices.own_key(learner["key"])
        _, data = acting.generate_unroll(env, worlds, act, key, config.unroll)
        seen = running_statistics.update(
            learner["normalizer"],
            data.observation,
            std_min_value=SMALLEST_STD,
            pmap_axis_name=devices.axis,
        )
        return seen, worlds

    seen, _ = jax.jit(devices.each(on_one))((learner_of(state), actor, own), state.env)
    steps = max(int(policy.meta.get("env_steps", 0)), config.steps_per_iteration)
    normalizer = knowing(seen, own, count=UInt64(hi=steps >> 32, lo=steps % 2**32))
    summed = {name: float(steps) * std**2 for name, std in normalizer.std.items()}
    begun = state._replace(
        params=state.params.replace(policy=actor),
        policy=jax.tree.map(jnp.copy, actor),
        normalizer=normalizer.replace(summed_variance=summed),
    )
    return begun._replace(**devices.common(learner_of(begun)))
