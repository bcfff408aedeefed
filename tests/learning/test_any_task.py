"""Learner and evaluation take any task: here one without a robot, a physics or a critic."""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import tiny_training as tiny
from scripted import draw_of

from mjx_grasp.evaluation.trials import run_trials, zero_controller
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.ppo import init_state, make_iteration
from mjx_grasp.tasks.task import EpisodeSummary, PacedTask, Task, TaskTick


class Points(NamedTuple):
    row: jax.Array
    place: jax.Array


class Homing:
    """Points on a line are to be brought to zero; a `Task`."""

    starts = None
    control_dt = 0.1
    episode_ticks = 8
    action_size = 1
    reward_names = ("near", "effort")

    def draw(self, key, worlds):
        return draw_of(np.zeros(worlds, int))._replace(
            offset=jax.random.uniform(key, (worlds, 2), minval=-1.0)
        )

    def start(self, draw):
        state = Points(draw.row, draw.offset[:, 0])
        return state, self._obs(state)

    def reset(self, state, mask, draw):
        new = Points(draw.row, draw.offset[:, 0])
        state = jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, state)
        return state, self._obs(state)

    def tick(self, state, action):
        action = jnp.clip(action[:, 0], -1.0, 1.0)
        state = state._replace(place=state.place + 0.1 * action)
        rewards = {"near": -jnp.abs(state.place), "effort": -0.01 * action**2}
        no = jnp.zeros(state.row.shape, bool)
        return state, TaskTick(self._obs(state), rewards, no, no, no)

    def summary(self, state):
        there, zero = jnp.abs(state.place) < 0.05, jnp.zeros(state.place.shape)
        return EpisodeSummary(
            state.row, there, ~there, there & ~there, there & ~there, there, zero, zero, zero, zero
        )

    def snapshot(self, state):
        return {"qpos": state.place[:, None], "row": state.row}

    def pack(self, state):
        return state._asdict()

    def unpack(self, packed):
        return Points(**packed)

    def _obs(self, state):
        return {"state": jnp.stack([state.place, jnp.sign(state.place)], axis=-1)}


class Told(NamedTuple):
    points: Points
    told: jax.Array
    """What the training has said last, in every world: share, episodes, successes."""


class PacedHoming(Homing):
    """The same, which remembers how far its training has come; a `PacedTask`."""

    pace_names = ("share", "ended", "succeeded")

    def start(self, draw):
        state, obs = super().start(draw)
        return Told(state, jnp.zeros((len(draw.row), 3))), obs

    def reset(self, state, mask, draw):
        points, obs = super().reset(state.points, mask, draw)
        return state._replace(points=points), obs

    def tick(self, state, action):
        points, tick = super().tick(state.points, action)
        return state._replace(points=points), tick

    def summary(self, state):
        return super().summary(state.points)

    def snapshot(self, state):
        return super().snapshot(state.points)

    def paced(self, state, learnt):
        said = dict(zip(self.pace_names, learnt, strict=True))
        told = jnp.broadcast_to(jnp.stack(learnt), state.told.shape)
        return state._replace(told=told), said


def test_it_is_a_task():
    assert isinstance(Homing(), Task) and not isinstance(Homing(), PacedTask)
    assert isinstance(PacedHoming(), PacedTask)


def test_a_task_that_goes_with_the_training_is_told_how_far_it_has_come():
    """After every iteration, with the episodes that are logged; and nothing else changes."""
    config = tiny.ppo(worlds=8, unroll=8, iterations=4, hidden=(4,), privileged_critic=False)
    env, plain = (BraxTask(t, 8, False) for t in (PacedHoming(), Homing()))
    state, other = (init_state(config, e, seed=0) for e in (env, plain))
    iterate, same = (jax.jit(make_iteration(config, e)) for e in (env, plain))
    for share in (0.25, 0.5):
        state, metrics = iterate(state)
        other, _ = same(other)
        assert (float(metrics["share"]), float(metrics["ended"])) == (share, 8)
        assert metrics["succeeded"] == pytest.approx(8 * metrics["success"])
        told = [float(metrics[name]) for name in env.pace_names]
        np.testing.assert_allclose(state.env.pipeline_state.told, [told] * 8)
    np.testing.assert_array_equal(tiny.parameters(state), tiny.parameters(other))
    assert plain.pace_names == ()


def test_it_is_evaluated():
    """A controller that goes home gets there, one that does nothing does not."""
    task = Homing()
    draw = task.draw(jax.random.PRNGKey(0), 12)
    home = run_trials(task, lambda obs: -10.0 * obs["state"][:, :1], draw, 5)
    still = run_trials(task, zero_controller(task), draw, 5)
    start = np.abs(draw.offset[:, 0])
    np.testing.assert_array_equal(home.success, start < 0.75 + 0.1)
    np.testing.assert_array_equal(still.success, start < 0.05)
    np.testing.assert_allclose(still.reward, -8 * start, rtol=1e-5)
    assert np.isnan(still.force_mean[~still.success]).all()
    assert not home.broken.any() and not home.overflow_ticks.any()


@pytest.mark.parametrize("stagger", [False, True])
def test_it_is_learnt(stagger):
    """Without a critic of its own: the return rises, terms and episodes are counted."""
    config = tiny.ppo(
        **dict(worlds=64, unroll=8, iterations=15, epochs=4, hidden=(16,)),
        **dict(learning_rate=1e-2, privileged_critic=False),
    )
    env = BraxTask(Homing(), config.worlds, stagger)
    state, iterate = init_state(config, env, seed=0), jax.jit(make_iteration(config, env))
    rewards = []
    for _ in range(config.iterations):
        state, metrics = iterate(state)
        metrics = {name: float(x) for name, x in metrics.items()}
        rewards.append(metrics["reward/near"])
        assert metrics["reward"] == pytest.approx(
            metrics["reward/near"] + metrics["reward/effort"], rel=1e-4
        )
    assert metrics["episodes"] == config.worlds
    assert np.mean(rewards[-3:]) > 0.75 * np.mean(rewards[:3])  # both are negative
    packed = env.pack(state.env)
    jax.tree.map(np.testing.assert_array_equal, env.unpack(packed).info, state.env.info)
