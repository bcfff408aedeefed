"""A policy on top of the closing controller: what it sees of each control tick (method §5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.closing.closer import Closer, CloserState
from mjx_grasp.errors import InputError
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.records.settings import NonNegative, Positive, Settings, Several, Share, WholeNumber
from mjx_grasp.robot.interface import Measured

FORCE_UNIT = 5.0
"""What the number 1 stands for where an observation holds a force [N]."""


@dataclass(frozen=True)
class KeepingConfig(Settings):
    """How a policy is held to its force budget: by what it is told of it."""

    gain: NonNegative = 0.0
    """g: how fast the budget that it is told follows what is spared or spent too much; 0: it is
    told its own [1/s]"""
    share: Share = 0.92
    """s: of the budget, that the mean force is to be; the rest is for errors of the estimate [-]"""
    least: Positive = 1.0
    """that it is told [N]"""
    most: Positive = 12.0
    """that it is told [N]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.least > self.most:
            raise InputError(self.name_of("least"), self.least, f"at most `most` ({self.most:g})")


KEEPING = KeepingConfig(gain=3.0)
"""Of a policy at work; in its training it is told its budget itself."""


@dataclass(frozen=True)
class ObservationConfig(Settings):
    """What the policy sees of each control tick, and of which ticks."""

    forces: bool = False
    """whether the estimated forces of the fingers, along and across their pressing direction, and
    the grip's own force stand beside joints and actions; for a torque-sensed hand"""
    budget: bool = False
    """whether the force budget does, the mean force per finger that a grasp may take"""
    keeping: KeepingConfig = field(default_factory=KeepingConfig)
    """how the budget that is read differs from the one that is given"""
    targets: bool = False
    """whether the three contacts do, in the palm's frame"""
    normals: bool = False
    """whether the surface's normals there do, in the same frame"""
    arm: bool = False
    """whether the positions of the arm's joints do"""
    others: bool = False
    """whether those of the joints do that closing leaves alone"""
    truth: bool = False
    """whether all that a critic may read does, contact forces, the object's pose and friction
    among it: no robot knows them; with it training tells what more sensing could bring at most"""
    ticks_ago: Annotated[tuple[WholeNumber, ...], Several(ascending=True, strictly=True)] = (0, 1)
    """the ticks that are stacked, the newest first [-]"""


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class LearnedPolicy:
    """A trained policy as a controller asks it; static under jit."""

    answer: Callable[[Float[Array, "*b d"]], Float[Array, "*b a"]]
    """actions for observations, in ±1"""
    observation: ObservationConfig
    """what those are made of"""
    budget: float = 3.0
    """force budget that it is given, if it reads one [N]"""


def observed_step(
    closer: Closer,
    state: CloserState,
    measured: Measured,
    targets: ThreePoints,
    last_action: Float[Array, "*b a"],
    config: ObservationConfig,
) -> Float[Array, "*b d"]:
    """What is seen of one tick.

    Args:
        closer: The controller.
        state: After `sense`.
        measured: Now.
        targets: The contacts.
        last_action: The policy's, zeros at first.
        config: What is seen.
    """
    at = closer.joints.at.fingers
    parts = [proprioception(measured.q[..., at], measured.qd[..., at], last_action)]
    if config.forces:
        load = closer.load(state, measured, targets)
        parts.append(felt(*load, closer.grip_force(state)))
    if config.targets:
        away = targets.position - measured.palm_pos[..., None, :]
        parts.append(in_palm_axes(measured, away))
    if config.normals:
        parts.append(in_palm_axes(measured, targets.normal))
    if config.arm:
        parts.append(measured.q[..., closer.joints.at.arm])
    if config.others:
        parts.append(measured.q[..., closer.joints.at.others])
    return jnp.concatenate(parts, axis=-1)


def first_stack(step: Float[Array, "*b d"], config: ObservationConfig) -> Float[Array, "*b s d"]:
    """Before the first action: as if all had been as it is now."""
    return jnp.repeat(step[..., None, :], config.ticks_ago[-1] + 1, axis=-2)


def pushed(stack: Float[Array, "*b s d"], step: Float[Array, "*b d"]) -> Float[Array, "*b s d"]:
    """The stack of steps, oldest first, with one more and without its oldest."""
    return jnp.concatenate([stack[..., 1:, :], step[..., None, :]], axis=-2)


def observation(
    stack: Float[Array, "*b s d"], budget: Float[Array, "*b"], config: ObservationConfig
) -> Float[Array, "*b e"]:
    """What the policy reads.

    Args:
        stack: Steps, oldest first.
        budget: Mean force per finger that the grasp may take, as it is `told` [N].
        config: Which of the steps, and whether the budget.
    """
    seen = [stack[..., -1 - ago, :] for ago in reversed(config.ticks_ago)]
    if config.budget:
        seen.append(budget[..., None] / FORCE_UNIT)
    return jnp.concatenate(seen, axis=-1)


def told(
    budget: Float[Array, "*b"], state: CloserState, dt: float, config: KeepingConfig
) -> Float[Array, "*b"]:
    """The budget that a policy reads, so that its mean force keeps to the one that is given [N].

    B̂ = B·exp(g·∫(s − F̂/B) dt) within bounds, from lift onset on, with the mean F̂ of the fingers'
    estimated forces: it rises while there is force to spare, and falls after more than the budget.

    Args:
        budget: B, mean force per finger that the grasp may take [N].
        state: Of the closing controller, after `sense`.
        dt: Its control period [s].
        config: g, s and bounds.
    """
    if not config.gain:
        return budget
    ticks = jnp.where(state.lifting, state.lift_tick + 1, 0)  # the onset's own tick counts
    spared = dt * (config.share * ticks - state.pressed / budget)
    return jnp.clip(budget * jnp.exp(config.gain * spared), config.least, config.most)


def proprioception(
    q: Float[Array, "*b m"], qd: Float[Array, "*b m"], last_action: Float[Array, "*b a"]
) -> Float[Array, "*b d"]:
    """One step of the observation: finger positions [rad], velocities [rad/s], last action."""
    return jnp.concatenate([q, qd, last_action], axis=-1)


def felt(
    normal: Float[Array, "*b f"], tangential: Float[Array, "*b f"], level: Float[Array, "*b"]
) -> Float[Array, "*b e"]:
    """Beside it for a torque-sensed hand: forces of the fingers and the grip's own, in 5 N."""
    return jnp.concatenate([normal, tangential, level[..., None]], axis=-1) / FORCE_UNIT


def in_palm_axes(measured: Measured, vectors: Float[Array, "*b n 3"]) -> Float[Array, "*b m"]:
    """World vectors by their components along the palm's axes, one after the other."""
    along = jnp.sum(measured.palm_mat[..., None, :, :] * vectors[..., None], axis=-2)
    return along.reshape(*along.shape[:-2], -1)
