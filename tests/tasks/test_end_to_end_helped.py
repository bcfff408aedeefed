"""What helps an end-to-end policy beyond the publication: each setting does what it says."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, draw_of, still

from mjx_grasp.closing.config import ActionConfig
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import InputError
from mjx_grasp.gym.worlds import Worlds
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig, RewardConfig, StartNoise
from mjx_grasp.tasks.curriculum import CurriculumConfig
from mjx_grasp.tasks.end_to_end import EndToEndTask
from mjx_grasp.tasks.layout import action_layout, observation_layout
from mjx_grasp.tasks.observation import policy_sizes
from mjx_grasp.tasks.way_home import build_way_home

QUIET = StartNoise(offset_m=0.0)
POSTURES, HEIGHT = 5, 0.1
CONFIG = EndToEndConfig(postures=POSTURES, raised=HEIGHT, curriculum=CurriculumConfig(kind="none"))
OTHERS = ActionConfig(arm_rate=0.5, residual="integrated", others=True)


@pytest.fixture(scope="module")
def way(scene, starts):
    return build_way_home(scene, starts, POSTURES, HEIGHT)


@pytest.fixture(autouse=True)
def _one_table(monkeypatch, way):
    """That of the module, made once."""

    def made(scene, starts, postures, raised):
        assert (postures, raised) == (POSTURES, HEIGHT)
        return way

    monkeypatch.setattr("mjx_grasp.tasks.end_to_end.build_way_home", made)


def make(scene, starts, script, config=CONFIG):
    return EndToEndTask(ScriptedPhysics(scene, script), starts, config, QUIET)


def begun(task, rows, share):
    return task.start(draw_of(rows)._replace(way=jnp.full(len(rows), share)))[0]


def play(task, state, actions):
    def tick(state, action):
        state, out = task.tick(state, action)
        return state, (state, out)

    return jax.jit(lambda s, a: jax.lax.scan(tick, s, a)[1])(state, actions)


def commanded(task, states):
    """Joint targets in robot order [t, w, n]."""
    return np.asarray(states.physics.ctrl)[..., task.physics.scene.addresses.robot_ctrl]


@pytest.mark.long
def test_the_other_joints_have_actions_until_the_lift(scene, starts):
    """Each moves its own joint at the rate of arm or fingers; after lift onset none does."""
    rows, ticks, lifts = [0] * 6, 8, 5
    script = still(starts, rows, ticks)
    script.truth.tip_found[lifts - 1 :] = True
    task = make(scene, starts, script, replace(CONFIG, action=OTHERS))
    at = task.closer.joints.at
    assert len(at.others) == 4 and task.action_size == 15 + 4
    begin, limits = np.asarray(starts.measured.q[0]), task.closer.joints.limits
    inward = np.where(begin < limits.mean(axis=1), 1.0, -1.0)[at.others]
    sign = np.concatenate([np.ones(15), inward])
    actions = jnp.tile(0.2 * sign * np.eye(6, 19, k=15), (ticks, 1, 1))
    states, _ = play(task, begun(task, rows, 0.0), actions)
    q = commanded(task, states) - begin
    still_one = q[:, 4:5]  # a world without an action
    for k, joint in enumerate(at.others):
        rate = 0.5 if joint in at.arm else 5.0
        expected = inward[k] * np.minimum(np.arange(ticks) + 1, lifts) * rate * 0.2 * 0.01
        np.testing.assert_allclose((q - still_one)[:, k, joint], expected, atol=2e-6)
        rest = np.delete(q[:lifts, k], joint, axis=-1)
        np.testing.assert_allclose(rest, np.delete(still_one[:lifts, 0], joint, axis=-1), atol=2e-6)


@pytest.mark.long
def test_the_other_joints_stop_at_their_limits(scene, starts):
    task = make(scene, starts, still(starts, [0], 2), replace(CONFIG, action=OTHERS))
    states, _ = play(task, begun(task, [0], 0.0), jnp.ones((600, 1, 19)).at[..., :15].set(0.0))
    at = task.closer.joints.at
    fingers = np.setdiff1d(at.others, at.arm)
    limits = task.closer.joints.limits[fingers]
    np.testing.assert_allclose(commanded(task, states)[-1, 0, fingers], limits[:, 1], atol=1e-6)


@pytest.mark.long
def test_the_layout_names_what_the_others_read_and_answer(scene, starts):
    robot = scene.robot
    config = replace(CONFIG, action=OTHERS, observation=ObservationConfig(others=True))
    sizes = policy_sizes(robot, config)
    seen, done = observation_layout(robot, config), action_layout(robot, config)
    assert (seen[-1].stop, done[-1].stop) == sizes
    names = [name for part in done for name in part.of]
    assert len(set(names)) == len(names) == 19
    task = make(scene, starts, still(starts, [4], 2), config)
    states, out = play(task, begun(task, [4], 0.5), jnp.zeros((2, 1, 19)))
    obs = np.asarray(out.obs["state"][-1, 0])
    for part in seen:
        if part.what == "other_position":
            joints = [robot.joints.index(name) for name in part.of]
            np.testing.assert_allclose(
                obs[part.start : part.stop], states.measured.q[-1, 0, joints], atol=1e-6
            )
    assert {part.what: part.one for part in done}["other_finger_joint"] == 5.0


@pytest.mark.long
def test_the_arm_is_faster_before_the_lift(scene, starts):
    ticks, lifts = 8, 4
    script = still(starts, [0, 0], ticks)
    script.truth.tip_found[lifts - 1 :] = True
    task = make(scene, starts, script, replace(CONFIG, reach_rate=2.0))
    actions = jnp.zeros((ticks, 2, 15)).at[:, 0, 9].set(0.1)
    states, _ = play(task, begun(task, [0, 0], 0.0), actions)
    joint = task.closer.joints.at.arm_policy[0]
    moved = commanded(task, states)[:, 0, joint] - commanded(task, states)[:, 1, joint]
    steps = np.diff(np.concatenate([[0.0], moved]))
    np.testing.assert_allclose(steps[:lifts], 2.0 * 0.1 * 0.01, atol=1e-6)
    np.testing.assert_allclose(steps[lifts:], 0.5 * 0.1 * 0.01, atol=1e-6)


@pytest.mark.parametrize("near", [True, False])
@pytest.mark.long
def test_guidance_acts_near_the_contacts_alone_and_straight_at_them(scene, starts, near):
    """Far away, the actions alone move the fingers; near, they are added to what guides."""
    script = still(starts, [0], 3)
    task = make(scene, starts, script)
    state = begun(task, [0], 0.0)
    targets = task._targets(jnp.array([0]), state.truth)
    away = np.linalg.norm(targets.position - state.measured.pad_pos, axis=-1).mean()
    within = float(away) * (1.1 if near else 0.9)
    config = replace(CONFIG, assisted=True, within=within, reward=RewardConfig(reach=0.0))
    task = make(scene, starts, script, config)
    state = begun(task, [0], 0.0)
    # As if the episode had begun elsewhere: the line from there does not matter.
    closer = state.closer._replace(start_pos=state.closer.start_pos + 0.1)
    field = np.asarray(task.closer.guidance(closer, state.measured, targets))
    way = np.asarray(targets.position - state.measured.pad_pos)
    speed = np.linalg.norm(field[..., :3], axis=-1)
    if near:
        np.testing.assert_allclose(np.cross(field[..., :3], way), 0.0, atol=1e-7)
        assert (np.sum(field[..., :3] * way, axis=-1) > 0).all() and speed.max() <= 0.08 + 1e-6
    else:
        assert (field == 0.0).all()
    states, _ = play(task, state, jnp.full((3, 1, 15), 0.1).at[..., 9:].set(0.0))
    fingers = task.closer.joints.at.fingers
    moved = commanded(task, states)[0, 0, fingers] - np.asarray(starts.measured.q[0])[fingers]
    held = np.asarray(states.closer.hold[0, 0]).ravel() - np.asarray(starts.measured.q[0])[fingers]
    residual = np.asarray(states.closer.residual[0, 0])
    np.testing.assert_allclose(moved, held + residual, atol=1e-6)
    if near:
        np.testing.assert_allclose(residual, 5.0 * 0.1 * 0.01, atol=1e-6)
        assert np.abs(held).max() > 1e-4
    else:
        np.testing.assert_allclose(held, 5.0 * 0.1 * 0.01, atol=1e-6)
        np.testing.assert_array_equal(residual, 0.0)


@pytest.mark.long
def test_without_a_bound_guidance_acts_anywhere_along_the_line_on_which_it_began(scene, starts):
    task = make(scene, starts, still(starts, [0], 2), replace(CONFIG, assisted=True))
    state = begun(task, [0], 1.0)
    targets = task._targets(jnp.array([0]), state.truth)
    beside = state.closer._replace(start_pos=state.closer.start_pos + 0.05)
    fields = [
        np.asarray(task.closer.guidance(closer, state.measured, targets))
        for closer in (state.closer, beside)
    ]
    assert all(np.linalg.norm(field[..., :3], axis=-1).min() > 0.05 for field in fields)
    assert np.abs(fields[0] - fields[1]).max() > 0.05, "it returns to another line"


@pytest.mark.parametrize(
    ("settings", "refused"),
    [
        (dict(within=0.04, reward=RewardConfig(reach=0.0)), "within"),
        (dict(within=0.04, assisted=True), "reach"),
    ],
)
def test_settings_that_pay_for_standing_still_are_refused(settings, refused):
    with pytest.raises(InputError, match=refused):
        replace(CONFIG, **settings)
    with pytest.raises(InputError, match="posture"):
        ClosingTaskConfig(reward=RewardConfig(posture=1.0))


@pytest.mark.long
def test_coming_home_along_the_way_pays_what_the_way_is_shorter(scene, starts, way):
    """Whatever path: the sum is the difference of the ends; in the lift nothing is paid."""
    rng, ticks, rows = np.random.default_rng(0), 12, [4]
    script = still(starts, rows, ticks)
    script.measured.q[:, 0, :18] += rng.normal(size=(ticks, 18)) * 0.3
    script.truth.tip_found[9:] = True
    reward = RewardConfig(posture=10.0, posture_near=0.2)
    task = make(scene, starts, script, replace(CONFIG, reward=reward))
    state = begun(task, rows, 1.0)
    _, out = play(task, state, jnp.zeros((ticks, 1, 15)))
    at = task.closer.joints.at
    moving = np.concatenate([at.arm_policy, at.fingers])

    def left(q):
        return max(float(way.left(jnp.asarray(q)[None], jnp.array(rows), moving)[0]), 0.2)

    paid = np.asarray(out.rewards["posture"][:, 0])
    first, last = left(state.measured.q[0]), left(script.measured.q[9, 0])
    np.testing.assert_allclose(paid[:10].sum(), 10.0 * (first - last), rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(paid[10:], 0.0)
    assert first > last and "posture" not in make(scene, starts, script).reward_names


@pytest.mark.parametrize("frontier", [0.0, 0.4, 1.0])
@pytest.mark.long
def test_a_share_of_the_episodes_begins_as_far_away_as_the_level_allows(scene, starts, frontier):
    curriculum = CurriculumConfig(kind="none", frontier=frontier)
    task = make(scene, starts, still(starts, [0], 2), replace(CONFIG, curriculum=curriculum))
    draw, level = task.draw(jax.random.PRNGKey(3), 4096), jnp.full(4096, 0.5)
    way = np.asarray(task._placed(draw, level).way)
    at_the_end = way == 0.5
    assert abs(at_the_end.mean() - frontier) < 0.03
    if frontier < 1:
        rest = way[~at_the_end]
        assert rest.min() >= 0 and rest.max() < 0.5 and abs(rest.mean() - 0.25) < 0.02
    home = task._placed(draw._replace(way=None), level).way
    np.testing.assert_array_equal(home, 1.0)


@pytest.mark.parametrize("given_up", [0.05, math.inf])
@pytest.mark.long
def test_a_training_gives_up_objects_that_are_pushed_away_or_slip(scene, starts, given_up):
    """World 0 pushes it before the lift, world 1 loses it in the lift, world 2 does nothing."""
    rows, ticks = [0, 0, 0], 8
    script = still(starts, rows, ticks)
    script.truth.object_pos[4:, 0, 0] += 0.06
    script.truth.tip_found[2:, 1] = True
    script.truth.object_pos[5:, 1, 2] -= 0.035
    task = make(scene, starts, script, replace(CONFIG, given_up=given_up))
    _, out = play(task, begun(task, rows, 0.0), jnp.zeros((ticks, 3, 15)))
    expected = np.zeros((ticks, 3), bool)
    if math.isfinite(given_up):
        expected[4:, 0] = expected[5:, 1] = True
    np.testing.assert_array_equal(out.over, expected)
    assert not np.asarray(out.broken).any()


@pytest.mark.long
def test_where_the_object_lay_from_the_first_and_what_slips_after_success_is_not_given_up(
    scene, starts
):
    """World 0 lies as far away as it may be drawn, world 1 has succeeded before it slips."""
    rows, ticks, offset = [0, 0], 90, 0.03
    script = still(starts, rows, ticks)
    script.truth.object_pos[:, 0, :2] += offset
    script.truth.tip_found[2:, 1] = True
    # Palm and object rise together, are held for long enough, and part.
    script.truth.object_pos[10:, 1, 2] += 0.12
    script.measured.palm_pos[10:, 1, 2] += 0.12
    script.truth.object_pos[70:, 1, 2] -= 0.05
    config = replace(CONFIG, given_up=0.01)
    noise = StartNoise(offset_m=offset)
    task = EndToEndTask(ScriptedPhysics(scene, script), starts, config, noise)
    states, out = play(task, begun(task, rows, 0.0), jnp.zeros((ticks, 2, 15)))
    assert bool(states.episode.progress.success[-1, 1]), "the script is a success"
    assert not np.asarray(out.over).any()


@pytest.mark.parametrize("fast", [2.0, None])
def test_the_layout_says_how_fast_the_arm_is_before_the_lift(scene, fast):
    config = replace(CONFIG, action=OTHERS, reach_rate=fast)
    one = {part.what: part.one for part in action_layout(scene.robot, config)}
    assert one["arm_residual"] == one["other_arm_joint"] == (fast or 0.5)


@pytest.mark.parametrize("ticks", [4, 900])
@pytest.mark.long
def test_what_is_over_ends_an_episode_for_learners_and_is_no_truncation(scene, starts, ticks):
    """World 0 fails in the fourth tick: in the middle of its time, or just at the end of it."""
    script = still(starts, [0, 0], 6)
    script.truth.object_pos[3:, 0, 0] += 0.06
    task = make(scene, starts, script, replace(CONFIG, given_up=0.05))
    task.draw = lambda key, worlds: draw_of([0] * worlds)._replace(way=jnp.zeros(worlds))
    task.episode_ticks = ticks
    env = BraxTask(task, 2, stagger=False)
    state, seen = jax.jit(env.reset)(jax.random.PRNGKey(0)), []
    for _ in range(6):
        state = jax.jit(env.step)(state, jnp.zeros((2, 15)))
        seen.append((state.done, state.info["truncation"], state.info["episode_done"]))
    done, truncated, counted = np.asarray(seen).transpose(1, 0, 2)
    late = [0, 0, 0, int(ticks == 4), 0, 0]
    np.testing.assert_array_equal(done.T, [[0, 0, 0, 1, 0, 0], late])  # and begins anew
    np.testing.assert_array_equal(truncated.T, [[0] * 6, late])
    np.testing.assert_array_equal(counted, done)
    worlds = Worlds(task)
    told, at = [], worlds.start(jax.random.split(jax.random.PRNGKey(1), 2))
    for _ in range(4):
        at, tick = worlds.tick(at, jnp.zeros((2, 15)))
        told.append((tick.terminated, tick.truncated))
    terminated, truncated = np.asarray(told).transpose(1, 2, 0)
    np.testing.assert_array_equal(terminated, [[0, 0, 0, 1], [0] * 4])
    np.testing.assert_array_equal(truncated, [[0] * 4, late[:4]])
