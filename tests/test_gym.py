"""Tasks as Gymnasium sees them. Its checker knows single environments only: the vector environment
is held against Gymnasium's own vector of them."""

from dataclasses import replace

import gymnasium
import handmade
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scripted import ScriptedPhysics, still

from mjx_grasp.errors import InputError
from mjx_grasp.gym import TaskEnv, TaskVectorEnv, closing_vector_env
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise, SuccessConfig
from mjx_grasp.tasks.starts import build_starts
from mjx_grasp.training.config import preset_config

EPISODE = 10
TASK = ClosingTaskConfig(episode_s=0.1, success=SuccessConfig(hold_s=0.02))


@pytest.fixture(scope="module")
def task():
    """One box, native engine, episodes of ten ticks."""
    scene, handoffs = handmade.box_handoffs_scene()
    physics = NativePhysics(scene, threads=1)
    noise = StartNoise(offset_m=0.01, friction=(0.4, 1.0))
    return ClosingTask(physics, build_starts(scene, handoffs, physics.substeps), TASK, noise)


@pytest.fixture(scope="module")
def env(task):
    return TaskVectorEnv(task, 2)


@pytest.fixture(scope="module")
def single(task):
    return TaskEnv(task)


@pytest.fixture
def scripted(scene, starts):
    """An environment that plays a script [t, w, ...], which starts again with every episode."""

    def make(script):
        physics = ScriptedPhysics(scene, script)
        worlds = script.measured.q.shape[1]
        return TaskVectorEnv(ClosingTask(physics, starts, TASK, StartNoise(offset_m=0.0)), worlds)

    return make


def actions(env, count):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (count, *env.action_space.shape)).astype(np.float32)


def rolled_out(env, seed, count):
    first, _ = env.reset(seed=seed)
    return [first, *(env.step(action)[0] for action in actions(env, count))]


def test_gymnasiums_checker_finds_nothing(single, recwarn):
    check_env(single)
    said = [str(warning.message) for warning in recwarn]
    # Joint velocities have no bound, and there is nothing to render.
    known = "-infinity", "infinity", "alternative render modes"
    assert [text for text in said if not any(words in text for words in known)] == []


class Alone(gymnasium.Env):
    """One of several that share what is compiled."""

    def __init__(self, task, worlds):
        self.env = TaskEnv(task)
        self.env._worlds = worlds
        self.observation_space, self.action_space = (
            self.env.observation_space,
            self.env.action_space,
        )
        self.reset, self.step = self.env.reset, self.env.step


@pytest.mark.long
def test_worlds_together_are_worlds_alone_in_gymnasiums_own_vector(task, env, single):
    """Observations, rewards, ends and infos, over resets."""
    alone = SyncVectorEnv(
        [lambda: Alone(task, single._worlds)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert env.metadata["autoreset_mode"] == alone.metadata["autoreset_mode"]
    assert env.observation_space == alone.observation_space
    assert env.action_space == alone.action_space
    found, expected = env.reset(seed=5), alone.reset(seed=5)
    for k, action in enumerate(actions(env, 2 * EPISODE + 3)):
        same(found, expected)
        found, expected = env.step(action), alone.step(action)
        ends = (k + 1) % EPISODE == 0
        assert found[3].all() == ends and ("final_obs" in found[-1]) == ends
    same(found, expected)


def same(found, expected, where="returned"):
    """Equal up to sums in another order; dictionaries by their names."""
    if isinstance(expected, dict):
        assert set(found) == set(expected), where
        for name in expected:
            same(found[name], expected[name], f"{where}[{name!r}]")
    elif isinstance(expected, tuple):
        for k, (x, y) in enumerate(zip(found, expected, strict=True)):
            same(x, y, f"{where}[{k}]")
    elif expected.dtype == object:
        same(np.stack(found), np.stack(expected), where)
    else:
        np.testing.assert_allclose(found, expected, atol=2e-3, err_msg=where)


def test_a_seed_stands_for_the_same_worlds(env):
    one, again, other = (rolled_out(env, seed, EPISODE + 2) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert np.abs(np.array(one) - other).max() > 1e-3
    # Until their actions differ, the second world of seed 3 is the first of seed 4.
    states = [env.reset(seed=seed) and env.state() for seed in (3, 4, [3, 4])]
    assert np.abs(states[0][0] - states[0][1]).max() > 1e-3
    np.testing.assert_allclose(states[0][1], states[1][0], atol=1e-6)
    np.testing.assert_array_equal(states[0], states[2])


def test_without_a_seed_a_reset_goes_on(env):
    """A hand that has not moved yet sees no difference; a critic sees where the object is."""

    def states(*seeds):
        return [env.reset(seed=seed) and env.state() for seed in seeds]

    first, second, third = states(3, None, None)
    assert len({x.tobytes() for x in (first, second, third)}) == 3
    np.testing.assert_array_equal(states(3, None), [first, second])


def test_what_is_returned_is_in_the_spaces_and_ones_own(env):
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space and env.state().shape[1:] == env.state_space.shape
    seen = env.step(env.action_space.sample())
    obs, reward, terminated, truncated, _ = seen
    assert obs in env.observation_space and env.state()[0] in env.state_space
    assert (reward.shape, terminated.dtype, truncated.dtype) == ((2,), bool, bool)
    for array in (obs, reward, terminated, truncated):
        array[...] = 0  # may be written to


def test_rewards_are_those_that_the_learner_here_sees(task, env):
    """From the same states: the snapshot of a Brax rollout is put into the environment."""
    brax = BraxTask(task, 2, stagger=False)
    env.reset(seed=0)
    state = jax.jit(brax.reset)(jax.random.PRNGKey(0))
    now = env._now._replace(task=state.pipeline_state, obs=state.obs)
    step = jax.jit(brax.step)
    for action in actions(env, 4):
        state = step(state, action)
        now, ticked = env._worlds.tick(now, action)
        np.testing.assert_allclose(ticked.reward, state.reward, atol=1e-3)
        np.testing.assert_allclose(now.obs["state"], state.obs["state"], atol=2e-3)


def test_what_came_of_an_episode_is_told_at_its_end(starts, scripted):
    script = still(starts, [0, 0], EPISODE)
    script.truth.tip_found[2:, 0] = True
    force = np.random.default_rng(0).uniform(1.0, 5.0, (EPISODE, 3)).astype(np.float32)
    script.truth.finger_force[:, 0, :, 2] = force
    for x in (script.truth.object_pos, script.measured.palm_pos):
        x[4:, 0, 2] += 0.12
    env = scripted(script)
    env.reset(seed=0)
    for action in np.zeros((EPISODE, *env.action_space.shape), np.float32):
        *_, truncated, info = env.step(action)
    assert truncated.all() and info["_final_info"].all()
    final = info["final_info"]
    np.testing.assert_array_equal(final["success"], [True, False])
    np.testing.assert_allclose(final["force_mean"], [force[2:].mean(), 0.0], rtol=1e-5)
    np.testing.assert_allclose(final["force_peak"], [force[2:].max(), 0.0], rtol=1e-5)
    assert final["peak_rise"][0] > 0.1 > final["peak_rise"][1]
    assert not info["success"].any(), "the next episodes have begun"


def test_a_broken_world_terminates_and_is_last_seen_whole(starts, scripted):
    """World 1 breaks in the middle of its episode, world 2 in the tick in which its time is up."""
    script = still(starts, [0] * 3, EPISODE)
    script.measured.q[3, 1] = script.measured.q[EPISODE - 1, 2] = np.nan
    env = scripted(script)
    env.reset(seed=0)
    zeros = np.zeros(env.action_space.shape, np.float32)
    for k in range(EPISODE):
        obs, reward, terminated, truncated, info = env.step(zeros)
        last = k == EPISODE - 1
        assert np.isfinite(obs).all() and np.isfinite(reward).all()
        np.testing.assert_array_equal(terminated, [False, k in (3, 7), last])
        np.testing.assert_array_equal(truncated, [last, False, False])
        if k == 3:
            assert info["final_obs"][0] is None and np.isfinite(info["final_obs"][1]).all()
            assert reward[1] == 0.0


def test_what_becomes_of_one_world_is_nothing_to_another(starts, scripted):
    """Nor does it change what the other draws for its next episodes."""

    def states(broken):
        script = still(starts, [0, 0], EPISODE)
        if broken:
            script.measured.q[3, 1] = np.nan
        env = scripted(script)
        env.reset(seed=0)
        zeros = np.zeros(env.action_space.shape, np.float32)
        return np.array([env.step(zeros) and env.state() for _ in range(5 * EPISODE)])

    whole, broken = states(False), states(True)
    np.testing.assert_allclose(whole[:, 0], broken[:, 0], atol=1e-6)
    assert np.abs(whole[3:, 1] - broken[3:, 1]).max() > 1e-3


def test_actions_are_clipped(env):
    env.reset(seed=1)
    ones = np.ones(env.action_space.shape, np.float32)
    found = env.step(5 * ones)[0]
    env.reset(seed=1)
    np.testing.assert_array_equal(found, env.step(ones)[0])


@pytest.mark.wrong_types
def test_what_cannot_be_is_refused(task, env, single):
    with pytest.raises(gymnasium.error.ResetNeeded):
        TaskVectorEnv(task, 2).step(np.zeros((2, task.action_size)))
    env.reset(seed=0)
    with pytest.raises(InputError, match="actions"):
        env.step(np.zeros(task.action_size))
    with pytest.raises(InputError, match="numbers that are not finite"):
        env.step(np.full(env.action_space.shape, np.nan))
    with pytest.raises(InputError, match="3 seeds"):
        env.reset(seed=[1, 2, 3])
    for seed in ([None, None], [1, 2.5], [], -1, True, "3", 2**32, [[1], [2, 3]]):
        with pytest.raises(InputError, match=r"seed.*whole number from 0 to .* or one per world"):
            env.reset(seed=seed)
    with pytest.raises(InputError, match=r"seed.*whole number from 0"):
        single.reset(seed=[3])
    seen, _ = env.reset(seed=np.int64(3))
    np.testing.assert_array_equal(seen, env.reset(seed=3)[0])
    env.reset(seed=np.arange(3, 5))
    np.testing.assert_array_equal(env.state(), env.reset(seed=[3, 4]) and env.state())


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(InputError, match="num_envs"):
        closing_vector_env(0)
    with pytest.raises(InputError, match="num_envs"):
        closing_vector_env(2.0)
    with pytest.raises(InputError, match="--preset"):
        closing_vector_env(2, "no such")
    config = replace(preset_config("cpu"), objects=("banana",))
    with pytest.raises(InputError, match="banana"):
        closing_vector_env(2, config)


@pytest.mark.long
def test_it_is_registered_by_its_name():
    env = gymnasium.make_vec("mjx_grasp.gym:mjx_grasp/Closing-v0", num_envs=3)
    assert isinstance(env.unwrapped, TaskVectorEnv) and env.num_envs == 3
    feeling = preset_config("cpu")
    assert env.unwrapped.task.config == feeling.task and env.unwrapped.task.noise == feeling.noise
    assert env.observation_space.shape == (3, 83) and env.action_space.shape == (3, 16)
