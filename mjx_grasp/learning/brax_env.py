"""The closing environment as a Brax environment, with resets, for Brax's rollout."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jaxtyping import Array

from mjx_grasp.tasks.closing import ClosingEnv, EnvState

EPISODE_FIELDS = (
    "truncation",
    "episode_done",
    "episode_success",
    "episode_reward",
    "episode_force",
    "broken",
    "overflow",
)
"""Fields of `State.info` that a rollout collects at every step."""


class BraxClosingEnv(Env):
    """All worlds advance together and are reset where their episode ends.

    `State.info["incident"]` keeps the packed state in which a world last stopped being finite,
    so that it can be written out and looked at.
    """

    def __init__(self, env: ClosingEnv, worlds: int, stagger: bool = True):
        self.env, self.worlds, self._stagger = env, worlds, stagger

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the observations."""
        shapes = jax.eval_shape(self.reset, jax.random.PRNGKey(0)).obs
        return {name: x.shape[1:] for name, x in shapes.items()}

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """What steps the physics."""
        return type(self.env.physics).__name__

    def reset(self, rng: Array) -> State:
        """Fresh worlds; with `stagger` their first episodes end at random ticks."""
        key, draw_key, clock_key = jax.random.split(rng, 3)
        state, obs = self.env.start(self.env.draw(draw_key, self.worlds))
        if self._stagger:
            ticks = self.env.config.episode_ticks
            deadline = jax.random.randint(clock_key, (self.worlds,), 1, ticks + 1)
            state = state._replace(episode=state.episode._replace(deadline=deadline))
        zeros = jnp.zeros(self.worlds)
        info: dict[str, Any] = dict.fromkeys(EPISODE_FIELDS, zeros)
        info["key"] = key
        info["incident"] = _first_world(self._packed(state), jnp.zeros((), jnp.int32))
        return State(state, obs, zeros, zeros, {}, info)

    def step(self, state: State, action: Array) -> State:
        """One control tick and, where an episode ended, a reset."""
        key, draw_key = jax.random.split(state.info["key"])
        before: EnvState = state.pipeline_state
        after, tick = self.env.tick(before, action)
        done = tick.truncated | tick.broken
        episode = after.episode
        # A staggered first episode is shorter than the task and says nothing about success.
        whole = done & (episode.deadline == self.env.config.episode_ticks)
        which = jnp.argmax(tick.broken)
        incident = jax.tree.map(
            lambda new, old: jnp.where(tick.broken.any(), new, old),
            _first_world(self._packed(before), which),
            state.info["incident"],
        )
        info = {
            "key": key,
            "incident": incident,
            "truncation": (tick.truncated & ~tick.broken).astype(jnp.float32),
            "episode_done": whole.astype(jnp.float32),
            "episode_success": (whole & episode.outcome.success).astype(jnp.float32),
            "episode_reward": jnp.where(whole, episode.total_reward, 0.0),
            "episode_force": jnp.where(
                whole & ~tick.broken, episode.force_sum / (episode.lift_tick + 1), 0.0
            ),
            "broken": tick.broken.astype(jnp.float32),
            "overflow": after.readings.overflow.astype(jnp.float32),
        }
        after, obs = self.env.reset(after, done, self.env.draw(draw_key, self.worlds))
        return State(after, obs, tick.reward, done.astype(jnp.float32), {}, info)

    def pack(self, state: State) -> dict[str, Any]:
        """A state as arrays for a checkpoint."""
        inner: EnvState = state.pipeline_state
        return {
            "physics": self.env.physics.pack(inner.physics),
            "rest": inner[1:],
            "brax": (state.obs, state.reward, state.done, state.info),
        }

    def unpack(self, packed: dict[str, Any]) -> State:
        """The state that `pack` described."""
        inner = EnvState(self.env.physics.unpack(packed["physics"]), *packed["rest"])
        obs, reward, done, info = packed["brax"]
        return State(inner, obs, reward, done, {}, info)

    def _packed(self, state: EnvState) -> dict[str, Array]:
        return {**self.env.physics.pack(state.physics), "row": state.episode.row}


def _first_world(packed: dict[str, Array], index: Array) -> dict[str, Array]:
    return {name: x[index] for name, x in packed.items()}
