"""A trained policy as one small file: normaliser and layers, no framework needed to read it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import RunningStatisticsState
from flax import linen
from jaxtyping import Array, Float

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.archive import (
    ArchiveKind,
    Arrays,
    ChecksumError,
    Header,
    read_archive,
    write_archive,
)
from mjx_grasp.records.settings import Settings
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity


@dataclass(frozen=True, eq=False)
class Policy:
    """A deterministic policy: the mean of the trained distribution, clipped to ±1."""

    mean: Float[np.ndarray, " d"]
    """Of the observations."""
    std: Float[np.ndarray, " d"]
    weights: tuple[Float[np.ndarray, "_ _"], ...]
    """Of each layer, inputs × outputs."""
    biases: tuple[Float[np.ndarray, " _"], ...]
    meta: dict[str, Any]
    """What the file says of its making: configuration of the task, provenance, objects."""
    robot: RobotIdentity = FIRST_ROBOT
    """Whose joints it reads and drives."""

    @property
    def observation_size(self) -> int:
        """Numbers the policy reads."""
        return len(self.mean)

    @property
    def action_size(self) -> int:
        """Numbers it answers with."""
        return len(self.biases[-1])

    def __call__(self, obs: Float[Array, "*b d"]) -> Float[Array, "*b a"]:
        """Actions for observations (`state`); pure, jittable."""
        x = (obs - self.mean) / self.std
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = x @ w + b
            if i < len(self.weights) - 1:
                x = linen.elu(x)
        return jnp.clip(x, -1.0, 1.0)

    def save(self, path: str | Path) -> None:
        """Writes the policy as an archive, all or nothing.

        Raises:
            FileError: The layers do not fit each other, or hold numbers that are not finite.
        """
        arrays = {"mean": self.mean, "std": self.std}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
        write_archive(path, _KIND, _Header(self.meta, self.robot), arrays)


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
    modules = policy_params["params"]
    try:
        hidden = modules["MLP_0"]
        layers = [hidden[f"hidden_{i}"] for i in range(len(hidden))]
        layers.append(next(v for k, v in modules.items() if k.startswith("Dense")))
    except (KeyError, StopIteration):
        raise InputError("policy_params", sorted(modules), "MLP_0 and a Dense mean head") from None
    return Policy(
        mean=np.asarray(normalizer.mean["state"], np.float32),
        std=np.asarray(normalizer.std["state"], np.float32),
        weights=tuple(np.asarray(layer["kernel"], np.float32) for layer in layers),
        biases=tuple(np.asarray(layer["bias"], np.float32) for layer in layers),
        meta=meta,
        robot=robot,
    )


def load_policy(path: str | Path) -> Policy:
    """Reads a policy.

    Raises:
        FileError: The file is missing, damaged, or no policy; or its layers do not fit.
    """
    header, arrays = read_archive(path, _KIND)
    weights, biases = _layers(arrays)
    return Policy(arrays["mean"], arrays["std"], weights, biases, header.meta, header.robot)


@dataclass(frozen=True)
class _Header(Settings):
    meta: dict
    robot: RobotIdentity = FIRST_ROBOT
    """Absent in version 1."""


def _layers(arrays: Arrays) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Weights and biases in their order."""
    count = range(sum(name.startswith("weight_") for name in arrays))
    return tuple(arrays[f"weight_{i}"] for i in count), tuple(arrays[f"bias_{i}"] for i in count)


def _check(path: Path, header: _Header, arrays: Arrays) -> None:
    """Layers that fit each other, and a scale that can be divided by."""
    try:
        weights, biases = _layers(arrays)
    except KeyError as error:
        raise FileError(path, f"no array {error}", "weights and biases of every layer") from None
    sizes = [len(arrays["mean"]), *map(len, biases)]
    found = [w.shape for w in weights]
    expected = list(pairwise(sizes))
    if found != expected or not found or len(arrays) != 2 + 2 * len(found):
        raise FileError(path, f"layers of shapes {found}", f"shapes {expected}, one or more")
    if not (arrays["std"] > 0).all():
        raise FileError(path, "std with zeros or less", "positive numbers")


def _from_version_1(header: Header, arrays: Arrays) -> tuple[Header, Arrays]:
    """With a checksum of its own, which leaves out shapes."""
    facts = {k: v for k, v in header.items() if k != "sha256"}
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    if digest.hexdigest() != header["sha256"]:
        raise ChecksumError
    return {"meta": header["meta"]}, arrays


_KIND = ArchiveKind(
    format="mjx_grasp policy",
    version=2,
    header=_Header,
    arrays={
        "mean": "float32 d",
        "std": "float32 d",
        "weight_*": "float32 _ _",
        "bias_*": "float32 _",
    },
    check=_check,
    older={1: _from_version_1},
)
