"""What the layout says of an observation is what stands there."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.closing.config import ActionConfig
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise
from mjx_grasp.tasks.layout import action_layout, observation_layout
from mjx_grasp.tasks.observation import policy_sizes

FEELING = ClosingTaskConfig(
    action=ActionConfig(grip_range=3.0),
    observation=ObservationConfig(forces=True, budget=True, ticks_ago=(0, 2)),
)


@pytest.mark.parametrize(
    "config",
    [ClosingTaskConfig(), FEELING, replace(FEELING, action=ActionConfig())],
    ids=["first", "feeling", "without grip"],
)
def test_segments_stand_side_by_side_and_fill_the_sizes(robot, config):
    for parts, size in zip(
        (observation_layout(robot, config), action_layout(robot, config)),
        policy_sizes(robot, config),
        strict=True,
    ):
        assert [part.start for part in parts] == [0, *(part.stop for part in parts[:-1])]
        assert parts[-1].stop == size
        assert all(part.of for part in parts)


@pytest.fixture(scope="module")
def driven(native, starts):
    """The observation after three ticks, and what each tick was made of."""
    noise = StartNoise(budget_n=(2.0, 4.0))
    task = ClosingTask(native, starts, FEELING, noise, with_privileged=False)
    state, _ = jax.jit(task.start)(task.draw(jax.random.PRNGKey(0), 4))
    tick, seen = jax.jit(task.tick), []
    for k in range(3):
        action = jax.random.uniform(jax.random.PRNGKey(k), (4, task.action_size), minval=-1.0)
        state, done = tick(state, action)
        targets = task._targets(state.episode.row, state.truth)
        pressing, sliding = task.closer.load(state.closer, state.measured, targets)
        seen.append(
            {
                "position": state.measured.q,
                "velocity": state.measured.qd,
                "last_action": action,
                "pressing_force": pressing,
                "sliding_force": sliding,
                "grip_force": task.closer.grip_force(state.closer)[:, None],
            }
        )
    return done.obs["state"], seen, state.episode.budget


def test_every_number_is_what_its_segment_says(robot, driven):
    obs, seen, budget = driven
    for part in observation_layout(robot, FEELING):
        found = part.one * np.asarray(obs[:, part.start : part.stop])
        if part.what == "force_budget":
            expected = budget[:, None]
        elif part.what.startswith("joint_"):
            columns = jnp.array([robot.joints.index(name) for name in part.of])
            expected = seen[-1 - part.ticks_ago][part.what.removeprefix("joint_")][:, columns]
        else:
            expected = seen[-1 - part.ticks_ago][part.what]
        # Jitted once, and once not: sums in another order.
        np.testing.assert_allclose(found, expected, atol=2e-4, err_msg=str(part))


def test_an_action_moves_what_its_segment_says(robot, native, starts):
    """At 1 instead of 0 the target goes by the residual of one tick, and no other joint's."""
    task = ClosingTask(native, starts, FEELING, StartNoise(), with_privileged=False)
    state, _ = task.start(task.draw(jax.random.PRNGKey(0), 1))
    targets, size = task._targets(state.episode.row, state.truth), task.action_size
    act = jax.jit(lambda action: task.closer.act(state.closer, state.measured, targets, action)[1])
    still = act(jnp.zeros((1, size)))
    for part in action_layout(robot, FEELING)[:2]:
        for k, joint in enumerate(part.of):
            moved = act(jnp.zeros((1, size)).at[0, part.start + k].set(0.5)) - still
            expected = np.zeros(len(robot.joints))
            expected[robot.joints.index(joint)] = 0.5 * part.one * FEELING.control_dt
            np.testing.assert_allclose(moved[0], expected, atol=1e-6, err_msg=joint)
