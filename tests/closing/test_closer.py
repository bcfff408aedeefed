"""Laws of the closing controller, whoever calls it: a robot, a batch, a simulation, a training."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scripted import draw_of

from mjx_grasp.closing import stages
from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import (
    ActionConfig,
    CloserConfig,
    ForceConfig,
    GripConfig,
    LiftConfig,
    StageConfig,
)
from mjx_grasp.closing.control import pad_jacobians
from mjx_grasp.robot.interface import measured_from_joints, measuring_kinematics
from mjx_grasp.sim.physics import make_params
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise

WORLDS, TICKS = 6, 40
ROWS = jnp.array([0, 3, 6, 1, 4, 8])
EAGER = CloserConfig(
    grip=GripConfig(together=False, approach_s=0.15, ramp_s=0.1),
    stages=StageConfig(acquisition_s=0.2),
    lift=LiftConfig(delay_s=0.05),
)
"""All of its stages within `TICKS`."""


@pytest.fixture(scope="module")
def closer(robot):
    return Closer.of(robot, EAGER)


@pytest.fixture(scope="module")
def at(closer):
    return closer.joints.at


@pytest.fixture(scope="module")
def feel(robot):
    """What a robot measures in a posture: the joints and torques decide all of it."""
    kinematics = measuring_kinematics(robot)
    return partial(measured_from_joints, kinematics)


@pytest.fixture(scope="module")
def walk(starts, at, feel):
    """A robot moved by chance: first measurement, targets, then what comes tick by tick [t, w].

    Some fingers are touched from outside, some joints are pressed for a while.
    """
    rng = np.random.default_rng(0)
    first, targets = jax.tree.map(lambda x: x[ROWS], (starts.measured, starts.targets))
    steps = rng.normal(size=(TICKS, *first.q.shape)) * 0.004
    q = jnp.asarray(first.q + steps.cumsum(0), jnp.float32)
    qd = jnp.asarray(rng.normal(size=q.shape) * 0.05, jnp.float32)
    pressed = rng.random((3, *first.external_torque[:, 0].shape)) < 0.2
    torque = np.repeat(np.repeat(pressed, 14, axis=0)[:TICKS, :, None], 5, axis=2) * 0.4
    torque = jnp.asarray(torque + rng.normal(size=torque.shape) * 0.01, jnp.float32)
    measured = jax.jit(jax.vmap(jax.vmap(feel)))(q, qd, torque)
    touching = jnp.asarray(rng.random((TICKS, WORLDS, 3)) < 0.02)
    action = jnp.asarray(rng.uniform(-1, 1, (TICKS, WORLDS, 15)), jnp.float32)
    return first, targets, (measured, touching, action)


def run(closer, first, targets, sequence):
    """States and commands of all ticks."""

    def tick(state, now):
        state, command = closer.tick(state, now[0], targets, *now[1:])
        return state, (state, command)

    return jax.lax.scan(tick, closer.start(first, targets), sequence)[1]


def close(a, b, atol=2e-6):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol, rtol=1e-5), a, b)


@pytest.fixture(scope="module")
def ran(closer, walk):
    return jax.device_get(jax.jit(partial(run, closer))(*walk))


def test_the_walk_goes_through_everything(ran, walk):
    """Or else the laws below would say little."""
    states, commands = ran
    for name in ("landed", "lifting", "observed"):
        flags = getattr(states, name)
        assert flags.any() and not flags.all(), name
    assert states.lifting[-1].sum() >= 2 and states.lift_tick.max() > 10
    assert states.grip_ticks.max() > 10 and (states.grip_ticks[10] == 0).any()
    outside, observed = np.asarray(walk[2][1]), states.observed
    assert (outside & ~observed).any() and (observed & ~outside).any()
    assert np.isfinite(commands).all()


def test_one_robot_is_a_row_of_a_batch(closer, walk, ran):
    alone = jax.jit(partial(run, closer))
    first, targets, sequence = walk
    for w in range(WORLDS):
        mine = jax.tree.map(lambda x, w=w: x[w], (first, targets))
        found = alone(*mine, jax.tree.map(lambda x, w=w: x[:, w], sequence))
        close(found, jax.tree.map(lambda x, w=w: x[:, w], ran))


def test_a_batch_is_the_map_over_its_robots(closer, walk, ran):
    mapped = jax.vmap(partial(run, closer), in_axes=(0, 0, 1), out_axes=1)
    close(jax.jit(mapped)(*walk), ran)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
@pytest.mark.long
def test_batches_have_any_shape(closer, walk, ran, shape):
    """Also of a state alone: its arrays have the batch in front and nothing else changes."""

    def shaped(x, before=0):
        x = jnp.asarray(x)
        some = jax.lax.slice_in_dim(x, 0, int(np.prod(shape)), axis=before)
        return some.reshape(*x.shape[:before], *shape, *x.shape[before + 1 :])

    first, targets, sequence = walk
    first, targets = jax.tree.map(shaped, (first, targets))
    begun = closer.start(first, targets)
    assert begun.tick.shape == begun.lifting.shape == shape
    assert begun.landed.shape == begun.grip_ticks.shape == (*shape, 3)
    found = jax.jit(partial(run, closer))(
        first, targets, jax.tree.map(lambda x: shaped(x, 1), sequence)
    )
    close(found, jax.tree.map(lambda x: shaped(x, 1), ran))


@pytest.mark.long
def test_compiled_is_as_written(closer, walk, ran):
    first, targets, sequence = walk
    state = closer.start(first, targets)
    for t in range(12):
        measured, touching, action = jax.tree.map(lambda x, t=t: x[t], sequence)
        state, command = closer.tick(state, measured, targets, touching, action)
        close((state, command), jax.tree.map(lambda x, t=t: x[t], ran))


def test_a_tick_is_what_was_sensed_then_the_act(closer, walk, ran):
    first, targets, sequence = walk
    sense, act = jax.jit(closer.sense), jax.jit(closer.act)
    state = closer.start(first, targets)
    for t in range(TICKS):
        measured, touching, action = jax.tree.map(lambda x, t=t: x[t], sequence)
        state = sense(state, measured, targets, touching)
        np.testing.assert_array_equal(state.tick, t)
        state, command = act(state, measured, targets, action)
        close((state, command), jax.tree.map(lambda x, t=t: x[t], ran))


def test_an_action_has_no_say_in_what_is_sensed(closer, walk, ran):
    """Stages, flags and observer depend on measurements and flags alone."""
    first, targets, (measured, touching, action) = walk
    other = jax.jit(partial(run, closer))(first, targets, (measured, touching, -action))[0]
    for name in ("observed", "landed", "grip_ticks", "lifting", "lift_tick"):
        np.testing.assert_array_equal(getattr(other, name), getattr(ran[0], name))
    assert (np.asarray(other.residual) != ran[0].residual).any()


# A whole episode, as a robot runs it.

FULL = ClosingTaskConfig(grip=GripConfig(force=5.0))


@pytest.fixture(scope="module")
def episode(starts, native):
    """States, rewards and actions of a whole episode of the task in native MuJoCo [t, w, ...]."""
    task = ClosingTask(native, starts, FULL, StartNoise(offset_m=0.0), with_privileged=False)
    rng = np.random.default_rng(1)
    actions = jnp.asarray(0.2 * rng.uniform(-1, 1, (FULL.episode_ticks, 2, 15)), jnp.float32)

    def tick(state, action):
        after, _ = task.tick(state, action)
        return after, after

    start = task.start(draw_of([0, 1]))[0]
    states = jax.jit(lambda s: jax.lax.scan(tick, s, actions)[1])(start)
    return start, states, actions


def test_the_tasks_commands_are_those_of_ticks_on_what_it_measured(robot, scene, starts, episode):
    """The task decides between sense and act, a robot in one tick: the commands are the same."""
    start, states, actions = episode
    assert states.episode.progress.success[-1].all()  # all stages were gone through
    closer = Closer.of(robot, FULL)
    targets = jax.tree.map(lambda x: x[jnp.array([0, 1])], starts.targets)
    before = jax.tree.map(
        lambda one, rest: jnp.concatenate([one[None], rest[:-1]]),
        (start.measured, start.truth.tip_found),
        (states.measured, states.truth.tip_found),
    )
    _, commands = jax.jit(partial(run, closer))(start.measured, targets, (*before, actions))
    sent = states.physics.ctrl[:, :, scene.addresses.robot_ctrl]
    np.testing.assert_allclose(commands, sent, atol=2e-6)


def test_a_loop_of_ticks_closes_and_lifts_as_the_task_does(robot, scene, starts, native, episode):
    """Read, tick, command: the task's own engine in the hands of a loop."""
    _, states, actions = episode
    closer, order = Closer.of(robot, FULL), np.argsort(scene.addresses.robot_ctrl)
    rows = jnp.array([0, 1])
    measured, targets = jax.tree.map(lambda x: x[rows], (starts.measured, starts.targets))
    physics = native.init(starts.qpos[rows], starts.ctrl[rows])
    params = make_params(starts.object_index[rows], 0.8)

    @jax.jit
    def period(carry, action):
        physics, measured, touching, state = carry
        state, command = closer.tick(state, measured, targets, touching, action)
        physics, measured, truth = native.step(physics, params, command[:, order])
        return (physics, measured, truth.tip_found, state), (command, truth.object_pos, state)

    begun = (physics, measured, jnp.zeros((2, 3), bool), closer.start(measured, targets))
    _, (commands, position, state) = jax.lax.scan(period, begun, actions)
    sent = states.physics.ctrl[:, :, scene.addresses.robot_ctrl]
    touched = int(np.argmax(np.asarray(states.truth.tip_found).any(axis=(1, 2))))
    np.testing.assert_allclose(commands[:touched], sent[:touched], atol=1e-5)
    # From the first contact on rounding may grow; what happens is the same.
    np.testing.assert_allclose(commands, sent, atol=0.02)
    np.testing.assert_allclose(position, states.truth.object_pos, atol=5e-3)
    onset = [np.asarray(s.lifting).argmax(axis=0) for s in (state, states.closer)]
    np.testing.assert_allclose(*onset, atol=3)


# Contact flags are an input.


def stand(first, ticks, **changes):
    """A robot that stays as it is for so many ticks, but for what is given of it."""
    return jax.tree.map(lambda x: jnp.repeat(x[None], ticks, axis=0), first._replace(**changes))


def one(starts, row=0):
    return jax.tree.map(lambda x: x[row], (starts.measured, starts.targets))


def quiet(ticks):
    """No flags, no action."""
    return jnp.zeros((ticks, 3), bool), jnp.zeros((ticks, 15))


def test_without_any_flags_it_closes_grips_and_never_lifts(robot, starts):
    """Nobody touches: the approach ends by its time, the force comes, the arm stays."""
    closer, (first, targets) = Closer.of(robot), one(starts)
    states, commands = jax.jit(partial(run, closer))(
        first, targets, (stand(first, 300), *quiet(300))
    )
    assert not states.landed.any() and not states.observed.any() and not states.lifting.any()
    # One second after the first command, which is tick 0.
    np.testing.assert_array_equal(states.grip_ticks[:, 0], np.maximum(np.arange(1, 301) - 101, 0))
    arm = closer.joints.at.arm
    np.testing.assert_array_equal(commands[:, arm], np.broadcast_to(first.q[arm], (300, len(arm))))


def test_as_published_only_touch_brings_force_and_landed_fingers_go_on(robot, starts):
    """Neither time nor distance count as arrival; the field moves the targets until the lift."""
    (first, targets), flags = one(starts), jnp.zeros((300, 3), bool).at[150:, 0].set(True)
    told = stand(first, 300), flags, jnp.zeros((300, 15))
    grip = GripConfig(together=False, arrival=0.0, approach_s=None, freezes=False)
    published, usual = (
        jax.jit(partial(run, Closer.of(robot, config)))(first, targets, told)[0]
        for config in (CloserConfig(grip=grip), CloserConfig(grip=GripConfig(together=False)))
    )
    ticks = published.grip_ticks
    assert not ticks[:150].any() and not ticks[:, 1:].any() and ticks[-1, 0] == 150
    assert (usual.grip_ticks[-1] > 0).all()
    assert (usual.hold[151:, 0] == usual.hold[151, 0]).all()
    untouched, _ = jax.jit(partial(run, Closer.of(robot, CloserConfig(grip=grip))))(
        first, targets, (stand(first, 300), *quiet(300))
    )
    np.testing.assert_array_equal(published.hold, untouched.hold)


def test_an_arm_that_settles_is_moved_by_no_action_once_the_lift_is_over(robot, starts):
    (first, targets), flags = one(starts), jnp.ones((300, 3), bool)
    told = stand(first, 300), flags, jnp.ones((300, 15))
    lift = LiftConfig(delay_s=0.1, height=0.1)
    ends = round(stages.lift_duration(lift) / 0.01)
    settled, restless = (
        jax.jit(partial(run, closer))(first, targets, told)[1][:, closer.joints.at.arm]
        for closer in (
            Closer.of(robot, CloserConfig(lift=lift, action=ActionConfig(arm_settles=settles)))
            for settles in (True, False)
        )
    )
    np.testing.assert_array_equal(settled[:ends], restless[:ends])
    assert (settled[ends + 1 :] == settled[ends + 1]).all()
    assert (np.abs(np.diff(restless[ends + 1 :, 0])) > 0).all()


@pytest.mark.parametrize(
    "fingers", [0, 3, 5, 7, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2, 4, 6))]
)
def test_flags_from_outside_land_their_fingers_and_three_begin_the_lift(robot, starts, fingers):
    """Whatever sets them: the solver, touch pads, a person."""
    closer, (first, targets) = Closer.of(robot), one(starts)
    flags = np.array([bool(fingers & 1 << f) for f in range(3)])
    touching = jnp.zeros((30, 3), bool).at[10].set(flags)  # once is enough to land
    states, _ = jax.jit(partial(run, closer))(
        first, targets, (stand(first, 30), touching, jnp.zeros((30, 15)))
    )
    np.testing.assert_array_equal(states.landed[9], [False] * 3)
    np.testing.assert_array_equal(states.landed[-1], flags)
    np.testing.assert_array_equal(states.lifting, flags.all() & (np.arange(30) >= 10))
    np.testing.assert_array_equal(states.lift_tick, flags.all() * np.maximum(np.arange(30) - 10, 0))
    assert not states.observed.any()


def test_the_observer_alone_is_as_good_as_flags_when_it_sees_something(robot, starts):
    """Torque on stalled joints against flags given at the tick in which it has made up its mind."""
    closer, (first, targets) = Closer.of(robot), one(starts)
    torque = jnp.zeros_like(first.external_torque)
    pressed = stand(first, 60)._replace(
        external_torque=jnp.repeat(torque[None], 60, axis=0).at[20:].set(0.3)
    )
    felt, by_itself = jax.jit(partial(run, closer))(first, targets, (pressed, *quiet(60)))
    seen = int(np.argmax(np.asarray(felt.observed).all(axis=-1)))
    assert 20 <= seen <= 25 and felt.lifting[-1]
    given = jnp.broadcast_to((jnp.arange(60) >= seen)[:, None], (60, 3))
    told, by_flags = jax.jit(partial(run, closer))(
        first, targets, (stand(first, 60), given, jnp.zeros((60, 15)))
    )
    np.testing.assert_array_equal(by_itself, by_flags)
    for name in ("landed", "grip_ticks", "lifting", "lift_tick"):
        np.testing.assert_array_equal(getattr(felt, name), getattr(told, name))
    assert felt.observed.any() and not told.observed.any()


def test_flags_and_observer_add_up(walk, ran):
    """A finger has landed once either has ever said so; its joints' targets then stay."""
    states, touching = ran[0], np.asarray(walk[2][1])
    ever = np.logical_or.accumulate(touching | states.observed)
    np.testing.assert_array_equal(states.landed, ever)
    stays = states.landed | states.lifting[..., None]
    moved = (states.hold[1:] != states.hold[:-1]).any(axis=-1)
    assert not moved[stays[1:] & stays[:-1]].any() and moved.any()


# What is commanded.


def test_dry_friction_of_moving_joints_is_no_force_where_it_is_known(robot, starts):
    closer = Closer.of(robot, CloserConfig(forces=ForceConfig(sticking=0.02)))
    unknowing = Closer.of(robot, CloserConfig())
    measured, targets = jax.tree.map(lambda x: x[0], (starts.measured, starts.targets))
    state, at = closer.start(measured, targets), closer.joints.at
    for way in (1.0, -1.0):
        moving = measured._replace(qd=measured.qd.at[at.grasping].set(0.5 * way))
        against = state.observer._replace(torque=-way * jnp.asarray(closer.joints.dry_friction))
        felt = closer.forces(state._replace(observer=against), moving)
        np.testing.assert_allclose(felt, 0.0, atol=1e-3)
        felt = unknowing.forces(state._replace(observer=against), moving)
        assert (jnp.linalg.norm(felt, axis=-1) > 0.05).all()
        # At rest nobody knows which way friction acts.
        assert (jnp.linalg.norm(closer.forces(state, measured), axis=-1) < 1e-3).all()
        still = closer.forces(state._replace(observer=against), measured)
        assert (jnp.linalg.norm(still, axis=-1) > 0.05).all()


def test_every_joint_of_a_finger_feels_what_parallel_ones_cannot(robot, starts, feel):
    """Joints that close along parallel axes feel nothing along these; the one that holds does."""
    measured, targets = jax.tree.map(lambda x: x[0], (starts.measured, starts.targets))
    knowing = Closer.of(robot, CloserConfig(forces=ForceConfig(damping=1e-4)))
    middle = jnp.asarray(knowing.joints.limits.mean(axis=1))  # away from every stop
    measured = feel(middle, jnp.zeros_like(middle), measured.external_torque)
    state, at = knowing.start(measured, targets), knowing.joints.at
    finger = 1  # the index
    along = measured.joint_axis[at.per_finger[finger][0]]
    jacobian = pad_jacobians(measured, at.grasping_per_finger)[finger]
    torque = jnp.zeros(at.grasping_per_finger.shape).at[finger].set(2.0 * along @ jacobian[:3])
    pressed = state._replace(observer=state.observer._replace(torque=torque.ravel()))
    np.testing.assert_allclose(knowing.forces(pressed, measured)[finger], 2.0 * along, atol=0.02)
    some = Closer.of(robot, CloserConfig(forces=ForceConfig(joints="moved")))
    assert jnp.linalg.norm(some.forces(pressed, measured)[finger]) < 0.1


def test_an_action_scales_the_grips_force_within_its_range(robot, starts):
    """Smoothly, from the level up to its range and down to the inverse; without a range, not."""
    measured, targets = jax.tree.map(lambda x: x[0], (starts.measured, starts.targets))
    closer = Closer.of(robot, CloserConfig(action=ActionConfig(grip_range=3.0)))
    assert closer.action_size == Closer.of(robot).action_size + 1
    act = jax.jit(closer.act)
    for way in (1.0, -1.0):
        state = closer.start(measured, targets)
        action = jnp.zeros(closer.action_size).at[-1].set(5.0 * way)  # beyond what it may be
        forces = [float(closer.grip_force(state))]
        for _ in range(60):
            state, _ = act(state, measured, targets, action)
            forces.append(float(closer.grip_force(state)))
        change = np.diff(np.log(forces)) * way
        assert (change[:20] > 0).all() and (np.diff(change[:20]) < 0).all()
        np.testing.assert_allclose(forces[-1], forces[0] * 3.0**way, rtol=1e-4)
    plain = Closer.of(robot)
    state, _ = plain.act(plain.start(measured, targets), measured, targets, jnp.ones(15))
    assert plain.grip_force(state) == state.level


def test_targets_follow_their_joints_until_the_lift_is_over(robot, starts):
    measured, targets = jax.tree.map(lambda x: x[0], (starts.measured, starts.targets))
    grip = GripConfig(follow=0.05, settles=True)
    closer = Closer.of(robot, CloserConfig(grip=grip))
    state, at = closer.start(measured, targets), closer.joints.at
    state = state._replace(landed=jnp.ones(3, bool), lifting=jnp.asarray(True))
    moved = measured._replace(q=measured.q.at[at.fingers].add(0.1))
    act, still = jax.jit(closer.act), jnp.zeros(closer.action_size)
    for tick, share in ((0, 0.05), (100, 0.05), (1000, 0.0)):
        after, _ = act(state._replace(lift_tick=jnp.asarray(tick)), moved, targets, still)
        np.testing.assert_allclose(after.hold - state.hold, share * 0.1, atol=1e-5)


def test_joints_that_closing_does_not_move_never_move(walk, ran, at):
    """Idle fingers, the finger joints that a policy leaves alone, the arm's last joint."""
    moved = np.concatenate([at.fingers, at.arm_policy])
    still = np.setdiff1d(np.arange(len(at.joints)), moved)
    assert len(still) == 12
    commands = ran[1]
    held = np.broadcast_to(walk[0].q[:, still], commands[..., still].shape)
    np.testing.assert_array_equal(commands[..., still], held)
    changed = (commands[1:] != commands[:-1]).any(axis=(0, 1))
    np.testing.assert_array_equal(np.flatnonzero(changed), np.sort(moved))


def test_fingers_lead_by_no_more_than_residual_lead_and_force_allow(walk, ran, closer, at):
    (states, commands), (measured, _, _) = ran, walk[2]
    free = ~(states.landed | states.lifting[..., None])
    q = np.asarray(measured.q)[..., at.per_finger]
    lead = np.abs(states.hold - q)[free]
    assert lead.max() <= EAGER.guidance.lead + 1e-6
    assert np.abs(states.residual).max() <= EAGER.action.limit + 1e-6
    # What is left is the grip: τ = JᵀF with joints at most 0.15 m from their pad.
    guided = states.hold.reshape(*states.hold.shape[:-2], -1)
    torque = (commands[..., at.fingers] - guided - states.residual) * closer.joints.stiffness
    force = np.repeat(np.minimum(states.grip_ticks * 0.01 / EAGER.grip.ramp_s, 1.0), 3, axis=-1)
    assert (np.abs(torque) <= 0.15 * EAGER.grip.force * force + 1e-4).all()
    assert np.abs(torque).max() > 0.01


@settings(max_examples=10)
@given(level=st.sampled_from([-1.0, 1.0]), force=st.floats(0, 10), seed=st.integers(0, 9))
def test_the_arm_never_leaves_its_range(robot, starts, level, force, seed):
    """Pushed the same way for ten seconds, or lifted from near a stop."""
    closer = Closer.of(robot, replace(EAGER, grip=replace(EAGER.grip, force=force)))
    (first, targets), arm = one(starts), closer.joints.at.arm
    low, high = closer.joints.limits[arm].T
    share = np.random.default_rng(seed).choice([0.001, 0.5, 0.999], len(arm))
    first = first._replace(q=first.q.at[arm].set(low + share * (high - low)))
    ticks = 1000
    action = jnp.full((ticks, 15), level)
    touching = jnp.broadcast_to((jnp.arange(ticks) > 100)[:, None], (ticks, 3))
    _, commands = jax.jit(partial(run, closer))(
        first, targets, (stand(first, ticks), touching, action)
    )
    found = np.asarray(commands[:, arm])
    assert (found >= low - 1e-6).all() and (found <= high + 1e-6).all()


@pytest.mark.parametrize("kind", ["leaky", "integrated"])
def test_an_action_moves_fingers_and_arm_by_the_configured_rates(robot, starts, kind):
    action = ActionConfig(finger_rate=2.0, arm_rate=0.1, residual=kind)
    closer, (first, targets) = Closer.of(robot, CloserConfig(action=action)), one(starts)
    at, sequence = closer.joints.at, stand(first, 2)
    still, moved = (
        run(closer, first, targets, (sequence, quiet(2)[0], jnp.full((2, 15), level)))[1]
        for level in (0.0, 0.5)
    )
    change = np.asarray(moved - still)
    second = 2.0 if kind == "integrated" else 1.0 + action.keep
    for t, times in enumerate((1.0, second)):
        np.testing.assert_allclose(change[t, at.fingers], 2.0 * 0.5 * 0.01 * times, atol=1e-6)
    for t in range(2):
        np.testing.assert_allclose(change[t, at.arm_policy], 0.1 * 0.5 * 0.01 * (t + 1), atol=1e-6)


# Targets that move.


@pytest.mark.parametrize("way", [(0, 0, 0), (0, 0.005, 0), (0, -0.004, 0), (0, 0, 0.004)])
def test_pads_follow_targets_that_move(robot, starts, feel, way):
    """A hand that goes where it is commanded; the object glides away while it closes.

    Along y, the way in which the pads come, and up: the wraps cannot move sideways.
    """
    closer, (first, targets) = (
        Closer.of(robot, CloserConfig(grip=GripConfig(force=0.0))),
        one(starts),
    )

    def period(carry, tick):
        state, q = carry
        share = jnp.clip(tick / 60, 0.0, 1.0)
        now = targets._replace(position=targets.position + share * jnp.array(way))
        measured = feel(q, jnp.zeros_like(q), first.external_torque)
        state, command = closer.tick(state, measured, now, jnp.zeros(3, bool), jnp.zeros(15))
        return (state, command), (measured.pad_pos, now.position)

    begun = (closer.start(first, targets), first.q)
    pads, goals = jax.jit(lambda s: jax.lax.scan(period, s, jnp.arange(200))[1])(begun)
    left = np.linalg.norm(pads - goals, axis=-1)
    assert left[0].min() > 0.006
    assert left[-1].max() < 0.0015
    missed = np.linalg.norm(pads[-1] - targets.position, axis=-1)
    assert missed.min() > np.linalg.norm(way) - 0.0015
