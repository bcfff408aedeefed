"""What a rollout is told of episodes: where they end, how, and what came of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, still

from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise, SuccessConfig

EPISODE = 10
TASK = ClosingTaskConfig(episode_s=0.1, success=SuccessConfig(hold_s=0.02))


@pytest.fixture(scope="module")
def rolled_out(scene, starts):
    """Steps through a script [t, w, ...], which starts again with every episode."""

    def run(script, ticks, stagger=False):
        worlds = script.measured.q.shape[1]
        task = ClosingTask(ScriptedPhysics(scene, script), starts, TASK, StartNoise(offset_m=0.0))
        env = BraxTask(task, worlds, stagger)

        def tick(state, _):
            state = env.step(state, jnp.zeros((worlds, env.action_size)))
            return state, (state.done, state.reward, state.info, state.obs["state"])

        first = jax.jit(env.reset)(jax.random.PRNGKey(0))
        out = jax.jit(lambda s: jax.lax.scan(tick, s, length=ticks)[1])(first)
        return first, *jax.tree.map(np.asarray, out)

    return run


def test_staggered_first_episodes_end_early_and_do_not_count(starts, rolled_out):
    first, done, _, info, _ = rolled_out(still(starts, [0] * 16, EPISODE), 3 * EPISODE, True)
    deadline = np.asarray(first.info["deadline"])
    assert len(set(deadline)) > 3 and deadline.min() >= 1 and deadline.max() <= EPISODE
    tick = np.arange(1, 3 * EPISODE + 1)[:, None]
    np.testing.assert_array_equal(done, (tick >= deadline) & ((tick - deadline) % EPISODE == 0))
    whole = done.astype(bool) & ((tick > deadline) | (deadline == EPISODE))
    np.testing.assert_array_equal(info["episode_done"], whole)
    np.testing.assert_array_equal(info["truncation"], done)


def test_a_broken_world_ends_without_being_truncated_and_starts_anew(starts, rolled_out):
    """World 1 breaks in the middle of its episode, world 2 in the tick in which its time is up."""
    script = still(starts, [0] * 3, EPISODE)
    script.measured.q[3, 1] = script.measured.q[EPISODE - 1, 2] = np.nan
    _, done, reward, info, obs = rolled_out(script, EPISODE)
    expected = np.zeros((EPISODE, 3))
    expected[[3, 7, EPISODE - 1], [1, 1, 2]] = 1.0
    np.testing.assert_array_equal(info["broken"], expected)
    np.testing.assert_array_equal(info["truncation"][:, 1:], 0.0)
    np.testing.assert_array_equal(info["truncation"][:, 0], np.arange(EPISODE) == EPISODE - 1)
    np.testing.assert_array_equal(done, np.maximum(expected, info["truncation"]))
    assert np.isfinite(reward).all() and np.isfinite(obs).all()


def test_an_episode_reports_what_came_of_it_at_its_end(starts, rolled_out):
    script = still(starts, [0, 0], EPISODE)
    script.truth.tip_found[2:, 0] = True
    force = np.random.default_rng(0).uniform(1.0, 5.0, (EPISODE, 3)).astype(np.float32)
    script.truth.finger_force[:, 0, :, 2] = force
    for x in (script.truth.object_pos, script.measured.palm_pos):
        x[4:, 0, 2] += 0.12
    _, done, reward, info, _ = rolled_out(script, EPISODE)
    np.testing.assert_array_equal(done[-1], 1.0)
    np.testing.assert_array_equal(info["episode_success"][-1], [1.0, 0.0])
    np.testing.assert_allclose(info["episode_force"][-1], [force[2:].mean(), 0.0], rtol=1e-5)
    np.testing.assert_allclose(info["episode_reward"][-1], reward.sum(0), rtol=1e-5)
    for name in ("episode_force", "episode_reward", "episode_done", "episode_success"):
        np.testing.assert_array_equal(info[name][:-1], 0.0)
