"""A trained policy as one small file: normaliser and layers, no framework needed to read it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import RunningStatisticsState
from flax import linen
from jaxtyping import Array, Float

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import replacing

_FORMAT = "mjx_grasp.policy/1"


@dataclass(frozen=True, eq=False)
class Policy:
    """A deterministic policy: the mean of the trained distribution, clipped to ±1."""

    mean: np.ndarray  # [d] of the observations
    std: np.ndarray  # [d]
    weights: tuple[np.ndarray, ...]  # [in, out] each
    biases: tuple[np.ndarray, ...]
    meta: dict[str, Any]
    """What the file says of its making: configuration of the task, provenance, objects."""

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
        """Writes the policy atomically, with a checksum."""
        arrays = self._arrays()
        header = {"format": _FORMAT, "layers": len(self.weights), "meta": self.meta}
        header["sha256"] = _digest(arrays, header)
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        with replacing(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, header=text, **arrays)

    def _arrays(self) -> dict[str, Any]:
        arrays: dict[str, Any] = {"mean": self.mean, "std": self.std}
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{i}": w, f"bias_{i}": b}
        return arrays


def policy_from_training(
    policy_params: Any, normalizer: RunningStatisticsState, meta: dict[str, Any]
) -> Policy:
    """Takes the actor out of a training.

    Args:
        policy_params: Parameters of Brax's policy network.
        normalizer: Observation statistics.
        meta: JSON-serialisable facts to keep with the policy.

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
    )


def load_policy(path: str | Path) -> Policy:
    """Reads a policy.

    Raises:
        FileError: The file is missing, damaged, or no policy of this format.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(path, "no such file", "a policy written by mjx_grasp.train")
    try:
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes())
    except Exception as error:
        raise FileError(
            path, f"an unreadable file ({error})", "a policy written by mjx_grasp.train"
        ) from None
    found = header.get("format") if isinstance(header, dict) else type(header).__name__
    if found != _FORMAT:
        raise FileError(path, f"format {found!r}", f"format {_FORMAT!r}")
    if _digest(arrays, header) != header.get("sha256"):
        raise FileError(path, "contents that do not match their checksum", "an undamaged policy")
    layers = range(header["layers"])
    return Policy(
        mean=arrays["mean"],
        std=arrays["std"],
        weights=tuple(arrays[f"weight_{i}"] for i in layers),
        biases=tuple(arrays[f"bias_{i}"] for i in layers),
        meta=header["meta"],
    )


def _digest(arrays: dict[str, np.ndarray], header: dict[str, Any]) -> str:
    """Of the arrays and of what the header says, its own checksum apart."""
    facts = {k: v for k, v in header.items() if k != "sha256"}
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()
