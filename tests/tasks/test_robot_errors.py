"""A robot that differs from its model, and a task that goes on as before where it does not."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, draw_of, still

from mjx_grasp.closing.config import REACTING
from mjx_grasp.closing.joints import driven_joints
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import InputError
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import (
    ClosingTaskConfig,
    RewardConfig,
    RobotErrors,
    StartNoise,
)
from mjx_grasp.tasks.observation import policy_sizes
from mjx_grasp.tasks.robot_errors import RobotDraw, arriving, as_sensed, longest_delay
from mjx_grasp.tasks.starts import balanced_weights, draw_starts

WORLDS, DT = 5, 0.01


def robots(**changes):
    exact = RobotDraw(
        jnp.ones(WORLDS), jnp.zeros(WORLDS), jnp.zeros(WORLDS), jnp.arange(WORLDS, dtype=jnp.int32)
    )
    return exact._replace(**changes)


@pytest.fixture(scope="module")
def joints(robot):
    return driven_joints(robot)


@pytest.fixture(scope="module")
def measured(starts):
    rng = np.random.default_rng(0)
    rest = jax.tree.map(lambda x: x[:WORLDS], starts.measured)
    torque = jnp.asarray(rng.normal(size=rest.external_torque.shape) * 0.1, jnp.float32)
    qd = jnp.asarray(rng.normal(size=rest.qd.shape), jnp.float32)
    return rest._replace(external_torque=torque, qd=qd)


def test_an_exact_robot_does_as_it_is_told(joints, measured):
    command = measured.q + 0.1
    arrived, sent = arriving(command, (), robots(), measured, joints, DT)
    np.testing.assert_array_equal(arrived, command)
    assert sent == ()
    assert as_sensed(measured, robots(), jnp.zeros(WORLDS, jnp.int32), joints, RobotErrors()) is (
        measured
    )


@pytest.mark.parametrize("latency", [0.005, 0.02, 0.045, 0.165])
def test_a_latency_that_all_have_is_one_wherever_halves_are_rounded_to(joints, measured, latency):
    delay = longest_delay(RobotErrors(latency_s=(latency, latency)), DT)
    sent, draw = (measured.q,) * delay, robots(latency=jnp.full(WORLDS, latency))
    for t in range(delay + 2):
        got, sent = arriving(measured.q + t + 1, sent, draw, measured, joints, DT)
        np.testing.assert_allclose(got - measured.q, max(t + 1 - delay, 0), atol=1e-5)


def test_commands_arrive_late(joints, measured):
    draw = robots(latency=jnp.array([0.0, 0.01, 0.02, 0.02, 0.0]))
    sent, arrived = (measured.q, measured.q), []
    for t in range(4):
        got, sent = arriving(measured.q + t + 1, sent, draw, measured, joints, DT)
        arrived.append(np.asarray(got - measured.q)[:, 0])
    expected = [[1, 0, 0, 0, 1], [2, 1, 0, 0, 2], [3, 2, 1, 1, 3], [4, 3, 2, 2, 4]]
    np.testing.assert_allclose(arrived, expected, atol=1e-5)


def test_soft_fingers_are_told_of_less_and_arms_of_all(joints, measured):
    draw = robots(stiffness=jnp.full(WORLDS, 0.5))
    arrived, _ = arriving(measured.q + 0.2, (), draw, measured, joints, DT)
    moved = np.asarray(arrived - measured.q)
    fingers = joints.at.fingers
    np.testing.assert_allclose(moved[:, fingers], 0.1, atol=1e-6)
    np.testing.assert_allclose(np.delete(moved, fingers, axis=1), 0.2, atol=1e-6)


def test_noise_of_torque_is_as_large_as_asked_and_new_every_tick(joints, measured):
    errors = RobotErrors(torque_std=0.05)
    seen = [
        as_sensed(measured, robots(), jnp.full(WORLDS, t), joints, errors).external_torque
        for t in range(60)
    ]
    noise = np.asarray(seen) - np.asarray(measured.external_torque)
    assert noise.std() == pytest.approx(0.05, rel=0.05) and abs(noise.mean()) < 2e-3
    assert (noise[0] != noise[1]).all() and (noise[0][0] != noise[0][1]).all()
    again = as_sensed(measured, robots(), jnp.full(WORLDS, 7), joints, errors)
    np.testing.assert_array_equal(again.external_torque, seen[7])


def test_torques_are_quantised_and_friction_is_mistaken(joints, measured):
    tick = jnp.zeros(WORLDS, jnp.int32)
    coarse = as_sensed(measured, robots(), tick, joints, RobotErrors(torque_step=0.02))
    steps = np.asarray(coarse.external_torque) / 0.02
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    worse = robots(friction=jnp.full(WORLDS, 0.3))
    off = as_sensed(measured, worse, tick, joints, RobotErrors(friction=0.3))
    error = np.asarray(off.external_torque - measured.external_torque)
    qd = np.asarray(measured.qd)[:, joints.at.grasping]
    fast = np.abs(qd) > 0.2
    expected = 0.3 * (joints.dry_friction * np.sign(qd) + joints.damping * qd)
    np.testing.assert_allclose(error[:, 0][fast], expected[fast], atol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [{"stiffness": (1.2, 0.8)}, {"latency_s": (0.02, 0.0)}, {"torque_std": -1.0}, {"friction": 2}],
)
def test_impossible_robots_are_refused(wrong):
    with pytest.raises(InputError):
        RobotErrors(**wrong)


def test_a_seed_stands_for_the_same_starts_whatever_else_is_drawn(starts):
    weights = balanced_weights(starts.object_index, 3)
    key, plain = jax.random.PRNGKey(5), StartNoise(friction=(0.4, 1.0))
    more = replace(
        plain,
        budget_n=(1.0, 6.0),
        robot=RobotErrors(stiffness=(0.7, 1.3), latency_s=(0.0, 0.03), friction=0.3),
    )
    a, b = (draw_starts(key, 64, noise, weights) for noise in (plain, more))
    for name in ("row", "offset", "rotation", "friction", "mass_scale"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert 1.0 <= b.budget.min() < 2.0 and 5.0 < b.budget.max() <= 6.0
    assert 0.7 <= b.robot.stiffness.min() < 0.8 and -0.3 <= b.robot.friction.min() < -0.2
    assert (a.budget == 3.0).all() and (a.robot.stiffness == 1.0).all()


@pytest.mark.parametrize(
    ("seen", "size"),
    [
        (ObservationConfig(), 66),
        (ObservationConfig(forces=True), 80),
        (ObservationConfig(forces=True, budget=True), 81),
        (ObservationConfig(ticks_ago=(0, 1, 25, 75)), 132),
    ],
)
def test_policies_see_what_their_task_says(scene, starts, seen, size):
    config = ClosingTaskConfig(grip=REACTING, observation=seen)
    task = ClosingTask(ScriptedPhysics(scene, still(starts, [0, 1], 3)), starts, config)
    state, obs = task.start(draw_of([0, 1])._replace(budget=jnp.array([2.0, 4.0])))
    assert obs["state"].shape == (2, size) == (2, policy_sizes(scene.robot, config)[0])
    _, tick = task.tick(state, jnp.zeros((2, 15)))
    assert tick.obs["state"].shape == (2, size)
    if seen.budget:
        np.testing.assert_allclose(tick.obs["state"][:, -1], [0.4, 0.8])


@pytest.mark.parametrize("seen", [ObservationConfig(), ObservationConfig(forces=True, budget=True)])
def test_a_policy_that_is_told_the_truth_reads_what_the_critic_reads(scene, starts, seen):
    config = ClosingTaskConfig(grip=REACTING, observation=replace(seen, truth=True))
    physics = ScriptedPhysics(scene, still(starts, [0, 1], 3))
    task = ClosingTask(physics, starts, config)
    state, obs = task.start(draw_of([0, 1]))
    _, tick = task.tick(state, jnp.zeros((2, 15)))
    for given in (obs, tick.obs):
        np.testing.assert_array_equal(given["state"], given["privileged_state"])
        assert given["state"].shape[1] == policy_sizes(scene.robot, config)[0]
    alone = ClosingTask(physics, starts, config, with_privileged=False)
    _, judged = alone.start(draw_of([0, 1]))
    assert judged.keys() == {"state"}
    np.testing.assert_array_equal(judged["state"], obs["state"])


def test_a_tight_budget_costs_and_a_wide_one_does_not(scene, starts):
    prices = RewardConfig(over_budget=-0.5, held=1.0, force=-0.1, spent=-0.3)
    config = ClosingTaskConfig(reward=prices)
    script = still(starts, [0, 0], 3)
    script.truth.finger_force[..., 2] = 4.0
    script.truth.tip_found[:] = True
    task = ClosingTask(ScriptedPhysics(scene, script), starts, config)
    state, _ = task.start(draw_of([0, 0])._replace(budget=jnp.array([3.0, 6.0])))
    for _ in range(2):  # the first tick touches, the second lifts
        state, tick = task.tick(state, jnp.zeros((2, 15)))
    np.testing.assert_allclose(tick.rewards["over_budget"], [-0.5, 0.0], atol=1e-5)
    np.testing.assert_allclose(tick.rewards["force"], -0.4, atol=1e-5)
    np.testing.assert_allclose(tick.rewards["spent"], [-0.3, -0.2], atol=1e-5)  # all, two thirds
    np.testing.assert_allclose(tick.rewards["held"], 1.0, atol=1e-5)


@pytest.mark.long
def test_the_budget_is_one_of_the_mean_force_since_lift_onset(scene, starts):
    config = ClosingTaskConfig(reward=RewardConfig(over_budget=-1.0))
    script = still(starts, [0], 6)
    script.truth.tip_found[:] = True
    script.truth.finger_force[..., 2] = np.array([5.0, 5.0, 1.0, 1.0, 1.0, 1.0])[:, None, None]
    task = ClosingTask(ScriptedPhysics(scene, script), starts, config)
    state, _ = task.start(draw_of([0])._replace(budget=jnp.array([3.0])))
    prices, means = [], []
    for _ in range(5):
        state, tick = task.tick(state, jnp.zeros((1, 15)))
        prices.append(float(tick.rewards["over_budget"][0]))
        means.append(float(task.summary(state).force_mean[0]))
    np.testing.assert_allclose(prices, -np.maximum(np.array(means) - 3.0, 0.0), atol=1e-5)
    assert max(means) > 3.0 > means[-1]  # dear at first, and paid back by gentleness
