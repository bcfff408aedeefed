"""Any task as a Brax environment, with resets, for Brax's rollout."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jaxtyping import Array, Float

from mjx_grasp.learning.devices import ONE_DEVICE, Devices
from mjx_grasp.tasks.curriculum import Learnt
from mjx_grasp.tasks.task import PacedTask, Task

EPISODE_FIELDS = (
    "truncation",
    "episode_done",
    "episode_success",
    "episode_reward",
    "episode_force",
    "reward_terms",
    "broken",
    "overflow",
)
"""Fields of `State.info` that a rollout collects at every step."""
_COMMON = ("key", "incident")
"""Fields that are alike on every device."""


class BraxTask(Env):
    """All worlds advance together and are reset where their episode ends.

    `State.info["incident"]` keeps the snapshot in which a world last stopped being finite, so that
    it can be written out and looked at.

    Args:
        task: With the worlds of one device.
        worlds: How many these are.
        stagger: Whether the first episodes end at random ticks.
        devices: Where the worlds are. `reset` and `step` are of one of them, and run on each
            through `Devices.each`.
    """

    def __init__(
        self, task: Task, worlds: int, stagger: bool = True, devices: Devices = ONE_DEVICE
    ):
        self.task, self.worlds, self._stagger, self.devices = task, worlds, stagger, devices
        self._fresh = jax.jit(devices.each(lambda key, _: ((), self.reset(key))))

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the observations."""
        task = self.task
        _, obs = jax.eval_shape(
            lambda key: task.start(task.draw(key, self.worlds)), jax.random.PRNGKey(0)
        )
        return {name: x.shape[1:] for name, x in obs.items()}

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.task.action_size

    @property
    def backend(self) -> str:
        """What runs the worlds."""
        return type(self.task).__name__

    def fresh(self, key: Array) -> State:
        """Fresh worlds on every device, compiled once."""
        return self._fresh(key, ())[1]

    def reset(self, rng: Array) -> State:
        """Fresh worlds; with `stagger` their first episodes end at random ticks."""
        key, draw_key, clock_key = jax.random.split(rng, 3)
        task = self.task
        own_key = self.devices.own_key
        state, obs = task.start(task.draw(own_key(draw_key), self.worlds))
        deadline = jnp.full(self.worlds, task.episode_ticks, jnp.int32)
        if self._stagger:
            ends = 1, task.episode_ticks + 1
            deadline = jax.random.randint(own_key(clock_key), (self.worlds,), *ends)
        zeros = jnp.zeros(self.worlds)
        info: dict[str, Any] = dict.fromkeys(EPISODE_FIELDS, zeros)
        info |= {
            "key": key,
            "age": jnp.zeros(self.worlds, jnp.int32),
            "deadline": deadline,
            "total_reward": zeros,
            "reward_terms": jnp.zeros((self.worlds, len(task.reward_names))),
            "incident": _first_world(task.snapshot(state), jnp.zeros((), jnp.int32)),
        }
        return State(state, obs, zeros, zeros, {}, info)

    def step(self, state: State, action: Float[Array, "w k"]) -> State:
        """One control tick and, where an episode ended, a reset."""
        task, info = self.task, state.info
        key, draw_key = jax.random.split(info["key"])
        after, tick = task.tick(state.pipeline_state, action)
        reward = sum(tick.rewards.values(), start=jnp.zeros(self.worlds))
        age, total = info["age"] + 1, info["total_reward"] + reward
        truncated = age >= info["deadline"]
        ended = tick.broken | tick.over
        done = truncated | ended
        # A staggered first episode is shorter than the task and says nothing about success.
        whole = done & (info["deadline"] == task.episode_ticks)
        summary = task.summary(after)
        counts = whole & ~tick.broken & summary.lifting
        incident = jax.tree.map(
            lambda new, old: jnp.where(tick.broken.any(), new, old),
            _first_world(task.snapshot(state.pipeline_state), jnp.argmax(tick.broken)),
            info["incident"],
        )
        info = {
            "key": key,
            "incident": incident,
            "age": jnp.where(done, 0, age),
            "deadline": jnp.where(done, task.episode_ticks, info["deadline"]),
            "total_reward": jnp.where(done, 0.0, total),
            "truncation": (truncated & ~ended).astype(jnp.float32),
            "episode_done": whole.astype(jnp.float32),
            "episode_success": (whole & summary.success).astype(jnp.float32),
            "episode_reward": jnp.where(whole, total, 0.0),
            "episode_force": jnp.where(counts, summary.force_mean, 0.0),
            "reward_terms": jnp.stack([tick.rewards[n] for n in task.reward_names], axis=-1),
            "broken": tick.broken.astype(jnp.float32),
            "overflow": tick.overflow.astype(jnp.float32),
        }
        draw = task.draw(self.devices.own_key(draw_key), self.worlds)
        after, obs = task.reset(after, done, draw)
        return State(after, obs, reward, done.astype(jnp.float32), {}, info)

    @property
    def pace_names(self) -> tuple[str, ...]:
        """What `paced` gives to log."""
        return self.task.pace_names if isinstance(self.task, PacedTask) else ()

    def paced(self, state: State, learnt: Learnt) -> tuple[State, dict[str, Float[Array, ""]]]:
        """After an iteration: a task that goes with the training is told how far it has come."""
        if not isinstance(self.task, PacedTask):
            return state, {}
        after, said = self.task.paced(state.pipeline_state, learnt)
        return state.replace(pipeline_state=after), said

    def incident(self, state: State) -> dict[str, Array]:
        """The snapshot in which a world last stopped being finite, from whichever device."""
        return self.devices.first(state.info["incident"])

    def pack(self, state: State) -> dict[str, Any]:
        """A state as arrays for a checkpoint: the worlds of all devices one after the other."""

        def on_one(_: Any, state: State) -> tuple[Any, Any]:
            info = dict(state.info)
            common = {name: info.pop(name) for name in _COMMON}
            task = self.task.pack(state.pipeline_state)
            return common, (task, (state.obs, state.reward, state.done, info))

        common, own = self.devices.each(on_one)((), state)
        task, (*others, info) = self.devices.joined(own)
        return {"task": task, "brax": (*others, info | common)}

    def unpack(self, packed: dict[str, Any]) -> State:
        """The state that `pack` described, on as many devices as there are now."""
        obs, reward, done, info = packed["brax"]
        common = {name: info[name] for name in _COMMON}
        others = {name: x for name, x in info.items() if name not in _COMMON}

        def on_one(common: Any, own: Any) -> tuple[Any, State]:
            task, (obs, reward, done, info) = own
            state = State(self.task.unpack(task), obs, reward, done, {}, info | common)
            return (), state

        own = self.devices.split((packed["task"], (obs, reward, done, others)))
        return self.devices.each(on_one)(common, own)[1]


def _first_world(snapshot: dict[str, Array], index: Array) -> dict[str, Array]:
    return {name: x[index] for name, x in snapshot.items()}
