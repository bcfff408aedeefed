"""A trained policy as it runs beside the task: from a training or a file, in JAX."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import RunningStatisticsState
from flax import linen
from jax.tree_util import Partial
from jaxtyping import Array, Float

from mjx_grasp.errors import InputError
from mjx_grasp.learning.stored_policy import StoredPolicy
from mjx_grasp.robot.identity import RobotIdentity

_Arrays = tuple[Any, Any, tuple[Any, ...], tuple[Any, ...]]
"""Mean, standard deviation, weights, biases."""


class Policy(StoredPolicy):
    """A policy that answers in JAX."""

    def __call__(self, obs: Float[Array, "*b d"]) -> Float[Array, "*b a"]:
        """Actions for observations (`state`); pure, jittable."""
        return _answer(self._arrays, obs)

    def controller(self) -> Callable[[Mapping[str, Array]], Float[Array, "w a"]]:
        """The policy as a controller of a task: from its observations to actions.

        Its arrays are a pytree's leaves, so that what is compiled for one policy serves others of
        the same sizes.
        """
        return Partial(_act, self._arrays)

    @property
    def _arrays(self) -> _Arrays:
        return self.mean, self.std, self.weights, self.biases


def _answer(arrays: _Arrays, obs: Float[Array, "*b d"]) -> Float[Array, "*b a"]:
    mean, std, weights, biases = arrays
    x = (obs - mean) / std
    for i, (w, b) in enumerate(zip(weights, biases, strict=True)):
        x = x @ w + b
        if i < len(weights) - 1:
            x = linen.elu(x)
    return jnp.clip(x, -1.0, 1.0)


def _act(arrays: _Arrays, obs: Mapping[str, Array]) -> Float[Array, "w a"]:
    return _answer(arrays, obs["state"])


def policy_from_training(
    policy_params: Any,
    normalizer: RunningStatisticsState,
    meta: dict[str, Any],
    robot: RobotIdentity,
) -> Policy:
    """Takes the actor out of a training.

    Args:
        policy_params: Parameters of Brax's policy network.
        normalizer: Observation statistics.
        meta: JSON-serialisable facts to keep with the policy.
        robot: The robot that was trained.

    Raises:
        InputError: The parameters are not those of a multi-layer perceptron with a mean head.
    """
    layers = [_at(policy_params, path) for path in _layer_paths(policy_params)]
    return Policy(
        mean=np.asarray(normalizer.mean["state"], np.float32),
        std=np.asarray(normalizer.std["state"], np.float32),
        weights=tuple(np.asarray(layer["kernel"], np.float32) for layer in layers),
        biases=tuple(np.asarray(layer["bias"], np.float32) for layer in layers),
        meta=meta,
        robot=robot,
    )


def actor_of(policy: StoredPolicy, policy_params: Any) -> Any:
    """The reverse: Brax's parameters with a policy's layers in the place of their own.

    Args:
        policy: The policy.
        policy_params: Parameters of a network with layers of the same sizes; what else they hold,
            the width of the exploration, stays.

    Raises:
        InputError: Layers of other sizes, or no multi-layer perceptron with a mean head.
    """
    actor = jax.tree.map(lambda x: x, policy_params)  # dictionaries of its own
    layers = [_at(actor, path) for path in _layer_paths(actor)]
    found, expected = [w.shape for w in policy.weights], [x["kernel"].shape for x in layers]
    if found != expected:
        raise InputError("policy", f"layers of {found}", f"layers of {expected}")
    for layer, weight, bias in zip(layers, policy.weights, policy.biases, strict=True):
        layer |= {"kernel": jnp.asarray(weight), "bias": jnp.asarray(bias)}
    return actor


def _layer_paths(policy_params: Any) -> list[tuple[str, ...]]:
    """Where the layers of Brax's policy network are, the first one first.

    Raises:
        InputError: It is no multi-layer perceptron with a mean head.
    """
    modules = policy_params["params"]
    try:
        hidden = [("MLP_0", f"hidden_{i}") for i in range(len(modules["MLP_0"]))]
        return [*hidden, (next(name for name in modules if name.startswith("Dense")),)]
    except (KeyError, StopIteration):
        raise InputError("policy_params", sorted(modules), "MLP_0 and a Dense mean head") from None


def _at(policy_params: Any, path: tuple[str, ...]) -> Any:
    return functools.reduce(lambda node, name: node[name], path, policy_params["params"])


def load_policy(path: str | Path) -> Policy:
    """Reads a policy.

    Raises:
        FileError: The file is missing, damaged, or no policy; or its layers do not fit.
    """
    return Policy.load(path)
