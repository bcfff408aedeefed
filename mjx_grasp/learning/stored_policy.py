"""What a policy file holds, a normaliser and layers, and how it is read; needs no JAX."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import FileError
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

P = TypeVar("P", bound="StoredPolicy")


@dataclass(frozen=True, eq=False)
class StoredPolicy:
    """A deterministic policy: the mean of the trained distribution, clipped to ±1.

    `Policy` answers in JAX, `NumpyPolicy` in NumPy.
    """

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

    @classmethod
    def load(cls: type[P], path: str | Path) -> P:
        """Reads a policy.

        Raises:
            FileError: The file is missing, damaged, or no policy; or its layers do not fit.
        """
        header, arrays = read_archive(path, _KIND)
        weights, biases = _layers(arrays)
        return cls(arrays["mean"], arrays["std"], weights, biases, header.meta, header.robot)

    def save(self, path: str | Path) -> None:
        """Writes the policy as an archive, all or nothing.

        Raises:
            FileError: The layers do not fit each other, or hold numbers that are not finite.
        """
        arrays = {"mean": self.mean, "std": self.std}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
        write_archive(path, _KIND, _Header(self.meta, self.robot), arrays)


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
