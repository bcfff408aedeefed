"""Any task as environments of Gymnasium: many worlds at once, or one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.gym.worlds import Worlds, WorldsState
from mjx_grasp.tasks.task import Task

_CRITIC = "privileged_state"


class TaskVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A task's worlds as one vector environment, reset in the step in which their episode ends.

    The observation of such a step is the next episode's first; the last is in
    `info["final_obs"]`, what came of the episode in `info["final_info"]`. World i with the seed s
    is what `TaskEnv` is with the seed s + i.

    Args:
        task: The task; where it tells a critic more, `state` does.
        num_envs: Worlds that advance together; the number that the task was made for.
    """

    def __init__(self, task: Task, num_envs: int):
        self.task, self.num_envs = task, num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self._worlds = Worlds(task)
        self._now: WorldsState | None = None
        self.single_observation_space, self.state_space = _spaces(self._worlds)
        self.single_action_space = _actions(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float[np.ndarray, "w d"], dict[str, Any]]:
        """Begins an episode in every world.

        Args:
            seed: Of the first world, the others count on from it; or one per world. Without any,
                worlds that have begun go on with the random numbers that they have.
            options: None are known.

        Raises:
            InputError: Not one seed, nor one per world.
        """
        first = None
        if seed is not None:
            seed = _whole(seed, most_axes=1)
            first = seed if isinstance(seed, int) else seed[0]
        super().reset(seed=first)
        if seed is None and self._now is not None:
            now = self._worlds.renew(self._now, jnp.ones(self.num_envs, bool))
        else:
            if seed is None:
                seed = int(self.np_random.integers(2**31))
            seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
            if len(seeds) != self.num_envs:
                raise InputError("seed", f"{len(seeds)} seeds", f"{self.num_envs}, one per world")
            now = self._worlds.start(_keys(seeds))
        self._now = now
        return np.array(now.obs["state"]), _masked(_infos(self._worlds, now))

    def step(
        self, actions: Float[np.ndarray, "w k"]
    ) -> tuple[
        Float[np.ndarray, "w d"],
        Float[np.ndarray, " w"],
        Bool[np.ndarray, " w"],
        Bool[np.ndarray, " w"],
        dict[str, Any],
    ]:
        """One control tick of every world; actions are clipped to ±1.

        Returns:
            Observations, rewards, which worlds stopped being finite or have failed already, whose
            time is up, and infos.

        Raises:
            InputError: Not one action per world, or one that is not finite.
            gymnasium.error.ResetNeeded: There was no `reset` yet.
        """
        taken = _taken(actions, self.action_space)
        now, ticked = self._worlds.tick(_begun(self._now), taken)
        terminated, truncated = np.array(ticked.terminated), np.array(ticked.truncated)
        ended = terminated | truncated
        infos: dict[str, Any] = {}
        if ended.any():
            last, came = np.array(now.obs["state"]), _infos(self._worlds, now)
            for i in map(int, np.flatnonzero(ended)):
                final = {"final_obs": last[i], "final_info": _of_world(came, i)}
                infos = self._add_info(infos, final, i)
            now = self._worlds.renew(now, jnp.asarray(ended))
        self._now = now
        infos |= _masked(_infos(self._worlds, now))
        return np.array(now.obs["state"]), np.array(ticked.reward), terminated, truncated, infos

    def state(self) -> Float[np.ndarray, "w e"] | None:
        """What a critic may see of the worlds as they are now, in `state_space`; see `Task`."""
        return np.array(_begun(self._now).obs[_CRITIC]) if self.state_space else None


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of a task.

    Args:
        task: The task, made for one world.
    """

    def __init__(self, task: Task):
        self.task = task
        self.metadata = {"render_modes": []}
        self._worlds = Worlds(task)
        self._now: WorldsState | None = None
        self.observation_space, _ = _spaces(self._worlds)
        self.action_space = _actions(task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " d"], dict[str, Any]]:
        """Begins an episode; without a seed one goes on with the random numbers there are.

        Raises:
            InputError: No such seed.
        """
        if seed is not None:
            seed = _whole(seed, most_axes=0)
        super().reset(seed=seed)
        if seed is None and self._now is not None:
            now = self._worlds.renew(self._now, jnp.ones(1, bool))
        else:
            seed = int(self.np_random.integers(2**31)) if seed is None else seed
            now = self._worlds.start(_keys([seed]))
        self._now = now
        return np.array(now.obs["state"][0]), _of_world(_infos(self._worlds, now), 0)

    def step(
        self, action: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " d"], float, bool, bool, dict[str, Any]]:
        """One control tick; see `TaskVectorEnv.step`."""
        taken = _taken(action, self.action_space)
        now, ticked = self._worlds.tick(_begun(self._now), taken[None])
        self._now = now
        terminated, truncated = bool(ticked.terminated[0]), bool(ticked.truncated[0])
        info = _of_world(_infos(self._worlds, now), 0)
        return np.array(now.obs["state"][0]), float(ticked.reward[0]), terminated, truncated, info


def _spaces(worlds: Worlds) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box | None]:
    """Of one world's observations, and of what its critic sees if that is more."""
    shapes = jax.eval_shape(worlds.start, _keys([0])).obs
    boxes = {
        name: gymnasium.spaces.Box(-np.inf, np.inf, seen.shape[1:], np.float32)
        for name, seen in shapes.items()
    }
    return boxes["state"], boxes.get(_CRITIC)


def _actions(task: Task) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def _whole(seed: Any, most_axes: int) -> Any:
    """One seed or a list of some, as Gymnasium wants them: whole numbers of Python, not negative.

    Raises:
        InputError: They are not.
    """
    each = " or one per world" if most_axes else ""
    expected = f"a whole number from 0 to 2³² − 1{each}"
    try:
        found = np.asarray(seed)
    except ValueError:  # rows of different lengths
        raise InputError("seed", seed, expected) from None
    whole = found.dtype.kind in "iu" and not (found < 0).any() and not (found >= 2**32).any()
    if found.ndim > most_axes or not whole:
        raise InputError("seed", seed, expected)
    return found.tolist()


def _keys(seeds: Sequence[int]) -> Array:
    """A key per world, that of its seed alone."""
    return jnp.stack([jax.random.PRNGKey(seed) for seed in seeds])


def _taken(actions: np.ndarray, space: gymnasium.Space[Any]) -> Float[np.ndarray, "*w k"]:
    found = np.asarray(actions, np.float32)
    if found.shape != space.shape:
        raise InputError("actions", found.shape, f"the shape {space.shape}")
    if not np.isfinite(found).all():
        raise InputError("actions", "numbers that are not finite", "finite ones")
    return found


def _begun(now: WorldsState | None) -> WorldsState:
    if now is None:
        raise gymnasium.error.ResetNeeded("step before reset")
    return now


def _infos(worlds: Worlds, now: WorldsState) -> dict[str, np.ndarray]:
    """What has come of every world's episode so far; copies."""
    return {name: np.array(x) for name, x in worlds.info(now).items()}


def _of_world(infos: dict[str, np.ndarray], world: int) -> dict[str, Any]:
    """One world's infos, as numbers of Python."""
    return {name: x[world].item() for name, x in infos.items()}


def _masked(infos: dict[str, np.ndarray]) -> dict[str, Any]:
    """With Gymnasium's flags of which worlds have an entry: all."""
    present = {f"_{name}": np.ones(len(x), bool) for name, x in infos.items()}
    return infos | present
