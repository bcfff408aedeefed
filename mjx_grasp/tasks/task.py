"""A task as a learner and an evaluation see it."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.tasks.curriculum import Learnt
from mjx_grasp.tasks.starts import StartDraw, StartTable

TaskState = Any
"""A task's own state: a pytree with the worlds in front."""

Observations = dict[str, Array]
"""`state` [w, d] for the policy and, where the task was asked for it, `privileged_state` [w, e] for
the critic."""


class TaskTick(NamedTuple):
    """What a control tick yields beside the next state."""

    obs: Observations
    rewards: dict[str, Float[Array, " w"]]
    """by the name of the term, weights included; zero in broken worlds"""
    broken: Bool[Array, " w"]
    """whether the world stopped being finite and has to be reset"""
    overflow: Bool[Array, " w"]
    """whether a contact or constraint buffer of the engine was full"""
    over: Bool[Array, " w"]
    """whether the episode has failed already, so that a training need not wait for its end"""


class EpisodeSummary(NamedTuple):
    """What has come of each episode so far."""

    row: Int[Array, " w"]
    """of the start table"""
    success: Bool[Array, " w"]
    never_lifted: Bool[Array, " w"]
    slipped: Bool[Array, " w"]
    not_held: Bool[Array, " w"]
    lifting: Bool[Array, " w"]
    """whether a lift has begun; there are no forces before"""
    force_mean: Float[Array, " w"]
    """finger force, mean over fingers and ticks since lift onset [N]"""
    force_peak: Float[Array, " w"]
    """largest force on one finger since lift onset [N]"""
    force_held: Float[Array, " w"]
    """the mean over the ticks in which the object is held off the table [N]; nan without any"""
    peak_rise: Float[Array, " w"]
    """largest rise of the object [m]"""


@runtime_checkable
class Task(Protocol):
    """Worlds that advance together; all methods are pure and work inside `jax.jit`.

    Episodes are cut, and worlds reset, by whoever drives the task.
    """

    starts: StartTable
    control_dt: float
    """control period [s]"""
    episode_ticks: int
    """control ticks of an episode"""
    action_size: int
    reward_names: tuple[str, ...]

    def draw(self, key: Array, worlds: int) -> StartDraw:
        """Draws starts, every object equally often."""
        ...

    def start(self, draw: StartDraw) -> tuple[TaskState, Observations]:
        """A fresh state of all worlds and its observations."""
        ...

    def reset(
        self, state: TaskState, mask: Bool[Array, " w"], draw: StartDraw
    ) -> tuple[TaskState, Observations]:
        """Starts the masked worlds anew and leaves the others as they are."""
        ...

    def tick(self, state: TaskState, action: Float[Array, "w k"]) -> tuple[TaskState, TaskTick]:
        """One control tick without a reset; actions are clipped to ±1."""
        ...

    def summary(self, state: TaskState) -> EpisodeSummary:
        """What has come of the episodes so far."""
        ...

    def snapshot(self, state: TaskState) -> dict[str, Array]:
        """What determines the physics' future and the episode's origin: `qpos`, `row` and so on."""
        ...

    def pack(self, state: TaskState) -> Any:
        """The state as a pytree of arrays, for a checkpoint."""
        ...

    def unpack(self, packed: Any) -> TaskState:
        """The state that `pack` described."""
        ...


@runtime_checkable
class PacedTask(Task, Protocol):
    """A task that a training makes harder as it goes on."""

    pace_names: tuple[str, ...]
    """what `paced` gives to log"""

    def paced(
        self, state: TaskState, learnt: Learnt
    ) -> tuple[TaskState, dict[str, Float[Array, ""]]]:
        """After an iteration: the state with what is changed for episodes to come.

        The second result is to be logged, and has to come out alike on every device.
        """
        ...
