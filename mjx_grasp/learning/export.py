"""A policy as ONNX: normaliser, layers and clipping in one graph, checked before it is there."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.controller import load_controller
from mjx_grasp.learning.driver_facts import driver_facts
from mjx_grasp.learning.policy import Policy
from mjx_grasp.records.atomic import check_writable, replacing
from mjx_grasp.records.settings import CommandSettings, Suffix
from mjx_grasp.robot.spec import load_robot

TOLERANCE = 1e-5
"""Most that an exported policy's answers may differ from the policy's own [-]."""
INPUT, OUTPUT = "observation", "action"
OPSET = 17
"""Of the graph: one that older runtimes know too."""


@dataclass(frozen=True)
class ExportConfig(CommandSettings):
    """Writes a policy as ONNX, with all that a driver needs to know as metadata."""

    policy: Annotated[Path, tyro.conf.Positional]
    """the policy (.npz), as a training leaves it in its folder"""
    out: Annotated[Path, Suffix((".onnx",))]
    """where to write (.onnx)"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot that the policy drives"""


class Exported(NamedTuple):
    """What became of an export."""

    difference: float
    """largest between the answers of the file and of the policy [-]"""
    observations: int
    """that both were asked"""


def export_policy(config: ExportConfig) -> Exported:
    """Writes a policy as ONNX once the file answers as the policy does.

    Args:
        config: Which policy, and where to.

    Raises:
        InputError: The file cannot be written, or the extra is not installed.
        FileError: The policy is unreadable or of another robot, or what was made of it answers
            otherwise; nothing is written then.
    """
    check_writable("--out", config.out)
    require_export()
    robot = load_robot(config.robot)
    policy = load_controller(config.policy, robot)
    model = onnx_model(policy, driver_facts(policy, config.policy, robot))
    obs = trial_observations(policy)
    with replacing(config.out) as temporary:
        temporary.write_bytes(model.SerializeToString())
        difference = largest_difference(policy, temporary, obs)
        if not difference <= TOLERANCE:
            found = f"answers that differ by up to {difference:.1e} from the policy's"
            raise FileError(config.out, found, f"{TOLERANCE:.0e} at most; nothing was written")
    return Exported(difference, len(obs))


def require_export() -> None:
    """Refuses to go on without the packages of the extra `export`.

    Raises:
        InputError: One is not installed.
    """
    for package in ("jax2onnx", "onnx", "onnxruntime"):
        if find_spec(package) is None:
            raise InputError("extra", f"no {package}", "pip install 'mjx_grasp[export]'")


def onnx_model(policy: Policy, facts: Mapping[str, str]) -> Any:
    """The policy as a graph from `observation` [batch, d] to `action` [batch, a], float32.

    Args:
        policy: The policy.
        facts: Metadata by name.

    Returns:
        The `onnx.ModelProto`.
    """
    import onnx
    from jax2onnx import to_onnx

    with _without_warnings("jax2onnx"):
        model = to_onnx(
            lambda obs: policy(obs),
            [("batch", policy.observation_size)],
            model_name="policy",
            opset=OPSET,
            input_names=[INPUT],
            output_names=[OUTPUT],
        )
    onnx.helper.set_model_props(model, dict(facts))
    onnx.checker.check_model(model)
    return model


def trial_observations(policy: Policy) -> Float[np.ndarray, "n d"]:
    """Random and extreme observations, in the standard deviations σ that training saw.

    Normal ones of 1, 3 and 10 σ; every number alone 10 σ above and below its mean; all of them at
    ±10 σ; the mean. Further out float32 itself answers less exactly than the tolerance, but where
    the clipping hides it.
    """
    rng, size = np.random.default_rng(0), policy.observation_size
    corners = rng.choice([-10.0, 10.0], (256, size))
    alone = 10.0 * np.eye(size)
    random = [spread * rng.standard_normal((256, size)) for spread in (1.0, 3.0, 10.0)]
    steps = np.concatenate([*random, alone, -alone, corners, np.zeros((1, size))])
    return (policy.mean + policy.std * steps).astype(np.float32)


def largest_difference(policy: Policy, file: Path, obs: Float[np.ndarray, "n d"]) -> float:
    """Between a file's answers in onnxruntime and the policy's in JAX, as a batch and one by one.

    Args:
        policy: The policy.
        file: What was made of it.
        obs: What both are asked.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])

    def answers(some: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k a"]:
        (found,) = session.run([OUTPUT], {INPUT: some})
        return np.asarray(found)

    with jax.default_matmul_precision("highest"):
        expected = np.asarray(jax.jit(policy)(jax.numpy.asarray(obs)))
    singly = np.concatenate([answers(single[None]) for single in obs])
    return float(np.abs(np.stack([answers(obs), singly]) - expected).max())


@contextmanager
def _without_warnings(name: str) -> Iterator[None]:
    """Silences a library that tells at length which of its parts it does without."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
