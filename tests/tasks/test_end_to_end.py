"""The end-to-end task: where it begins, what goes with the object, what its actions do."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scripted import Script, ScriptedPhysics, draw_of, still

from mjx_grasp.closing.config import ActionConfig, GripConfig, StageConfig
from mjx_grasp.closing.guidance import goal_frame
from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import to_record
from mjx_grasp.sim.physics import Truth
from mjx_grasp.tasks.assemble import World
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig, RewardConfig, StartNoise
from mjx_grasp.tasks.curriculum import CurriculumConfig
from mjx_grasp.tasks.end_to_end import EndToEndTask, carried, in_object
from mjx_grasp.tasks.observation import policy_sizes
from mjx_grasp.tasks.record import task_from_record
from mjx_grasp.tasks.task import PacedTask, Task
from mjx_grasp.tasks.way_home import build_way_home, nearest_free

QUIET = StartNoise(offset_m=0.0)
POSTURES = 5
CONFIG = EndToEndConfig(postures=POSTURES)


@pytest.fixture(scope="module")
def way(scene, starts):
    return build_way_home(scene, starts, POSTURES)


@pytest.fixture(autouse=True)
def _one_table(monkeypatch, way):
    """That of the module, made once."""
    monkeypatch.setattr("mjx_grasp.tasks.end_to_end.build_way_home", lambda *_, **__: way)


def make(scene, starts, script, config=CONFIG, **settings):
    return EndToEndTask(ScriptedPhysics(scene, script), starts, config, QUIET, **settings)


def begun(task, rows, share):
    """A state that has begun at a share of the whole way, and its observations."""
    draw = draw_of(rows)._replace(way=None if share is None else jnp.full(len(rows), share))
    whole = replace(task.config.curriculum, kind="none")
    task.config = replace(task.config, curriculum=whole)
    return task.start(draw)


def play(task, state, actions):
    """States after each tick and what the ticks yielded, stacked."""

    def tick(state, action):
        state, out = task.tick(state, action)
        return state, (state, out)

    return jax.jit(lambda s, a: jax.lax.scan(tick, s, a)[1])(state, actions)


def moved(starts, rows, ticks, seed=0):
    """A script in which the object is anywhere, turned in any way, tick by tick."""
    script, rng = still(starts, rows, ticks), np.random.default_rng(seed)
    script.truth.object_pos[:] += rng.uniform(-0.1, 0.1, script.truth.object_pos.shape)
    quat = rng.normal(size=script.truth.object_quat.shape)
    script.truth.object_quat[:] = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return script


def matrix(quat):
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, np.asarray(quat, float))
    return found.reshape(3, 3)


def test_it_is_a_task_that_goes_with_a_training(scene, starts):
    task = make(scene, starts, still(starts, [0], 2))
    assert isinstance(task, Task) and isinstance(task, PacedTask)
    closing = ClosingTask(ScriptedPhysics(scene, still(starts, [0], 2)), starts, None, QUIET)
    assert not isinstance(closing, PacedTask)
    assert task.reward_names == closing.reward_names
    assert (task.episode_ticks, task.action_size) == (900, 15)


def test_at_the_handoff_it_begins_exactly_as_the_closing_task(scene, starts, native):
    rows = [0, 4, 8]
    ours = EndToEndTask(native, starts, CONFIG, QUIET)
    state, _ = begun(ours, rows, 0.0)
    other, _ = ClosingTask(native, starts, ClosingTaskConfig(), QUIET).start(draw_of(rows))
    for name in ("physics", "params", "measured", "truth", "closer"):
        pairs = zip(
            *(jax.tree.leaves(getattr(s, name)) for s in (state, other)),
            strict=True,
        )
        for found, expected in pairs:
            np.testing.assert_array_equal(found, expected, err_msg=name)


@pytest.mark.parametrize("share", [1.0, None])
def test_at_the_end_of_the_way_and_in_evaluations_it_begins_at_home(scene, starts, native, share):
    rows = [0, 4, 8]
    state, obs = begun(EndToEndTask(native, starts, CONFIG, QUIET), rows, share)
    home = np.array(scene.robot.home, np.float32)
    np.testing.assert_array_equal(state.measured.q, np.tile(home, (3, 1)))
    np.testing.assert_array_equal(state.physics.ctrl[:, scene.addresses.robot_ctrl], [home] * 3)
    np.testing.assert_array_equal(state.truth.object_pos, starts.truth.object_pos[jnp.array(rows)])
    # What is measured there is MuJoCo's.
    data = mujoco.MjData(scene.model)
    data.qpos[:] = state.physics.qpos[1]
    mujoco.mj_kinematics(scene.model, data)
    at = scene.addresses
    np.testing.assert_allclose(state.measured.pad_pos[1], data.site_xpos[at.pad_sites], atol=1e-6)
    np.testing.assert_allclose(state.measured.palm_pos[1], data.site_xpos[at.palm_site], atol=1e-6)
    assert np.isfinite(obs["privileged_state"]).all()


def test_between_them_the_joints_are_on_a_straight_line(scene, starts, way):
    q = np.asarray(way.measured.q).reshape(len(starts.qpos), POSTURES, -1)
    handoff, home = np.asarray(starts.measured.q), np.array(scene.robot.home)
    for i, share in enumerate((0.0, 0.25, 0.5, 0.75, 1.0)):
        np.testing.assert_allclose(q[:, i], handoff + share * (home - handoff), atol=1e-6)


def test_a_posture_in_collision_gives_way_to_the_nearest_that_is_free():
    free = np.array([[1, 0, 0, 1, 1], [1, 1, 1, 1, 0], [1, 0, 0, 0, 0], [1, 0, 1, 0, 1]], bool)
    np.testing.assert_array_equal(
        nearest_free(free), [[0, 0, 3, 3, 4], [0, 1, 2, 3, 3], [0] * 5, [0, 0, 2, 2, 4]]
    )


def test_postures_that_touch_the_object_are_found_and_not_begun_in(scene, starts):
    """The ball where the palm is halfway home; of other objects there it knows nothing."""
    plain = build_way_home(scene, starts, 3)
    palm = np.asarray(plain.measured.palm_pos).reshape(-1, 3, 3)[:, 1]
    at = scene.addresses.object_qpos[:3]
    ball = 4
    inside = starts._replace(qpos=starts.qpos.at[ball, at].set(palm[ball]))
    way = build_way_home(scene, inside, 3)
    assert way.blocked > plain.blocked and plain.nearest[ball, 1] == 1 != way.nearest[ball, 1]
    others = np.arange(len(starts.qpos)) != ball
    np.testing.assert_array_equal(way.nearest[others], plain.nearest[others])
    taken = int(way.row(jnp.array([ball]), jnp.array([0.5]))[0])
    assert taken == 3 * ball + int(way.nearest[ball, 1])


@pytest.mark.long
def test_draws_reach_as_far_as_the_level_and_resets_keep_it(scene, starts, way):
    rows = [0] * 64
    config = replace(CONFIG, curriculum=CurriculumConfig(start=0.5))
    task = make(scene, starts, still(starts, rows, 2), config)
    handoff, home = np.asarray(starts.measured.q[:, 0]), scene.robot.home[0]

    def share(state):
        first = handoff[np.asarray(state.episode.row)]
        return (np.asarray(state.measured.q[:, 0]) - first) / (home - first)

    draw = task.draw(jax.random.PRNGKey(1), 64)
    assert 0 <= float(draw.way.min()) < 0.1 and 0.9 < float(draw.way.max()) < 1
    state, _ = task.start(draw)
    asked = np.round(0.5 * 4 * np.asarray(draw.way)).astype(int)
    assert set(asked) == {0, 1, 2}
    taken = np.asarray(way.nearest)[np.asarray(draw.row), asked]
    np.testing.assert_allclose(share(state), taken / 4, atol=1e-5)
    state = state._replace(beside=state.beside._replace(level=jnp.ones(64)))
    mask = jnp.arange(64) < 48
    later, _ = task.reset(state, mask, task.draw(jax.random.PRNGKey(2), 64))
    assert share(later)[:48].max() == pytest.approx(1.0)
    np.testing.assert_array_equal(later.measured.q[48:], state.measured.q[48:])
    np.testing.assert_array_equal(later.beside.level, 1.0)
    # The same key draws the closing task's starts.
    closing = ClosingTask(ScriptedPhysics(scene, still(starts, rows, 2)), starts, None, QUIET)
    for ours, other in zip(draw[:-1], closing.draw(jax.random.PRNGKey(1), 64)[:-1], strict=True):
        jax.tree.map(np.testing.assert_array_equal, ours, other)


def test_contacts_go_with_the_object(scene, starts):
    """Against matrices of MuJoCo, of objects that were moved and turned at random."""
    rows = [0, 4, 8]
    script = moved(starts, rows, 3)
    task = make(scene, starts, script)
    local = in_object(starts.targets, starts.truth)
    for t in range(3):
        truth = Truth(*(jnp.asarray(x[t]) for x in script.truth))
        found = task._targets(jnp.array(rows), truth)
        for w, row in enumerate(rows):
            old, new = matrix(starts.truth.object_quat[row]), matrix(truth.object_quat[w])
            way = np.asarray(starts.targets.position[row]) - np.asarray(
                starts.truth.object_pos[row]
            )
            expected = way @ old @ new.T + np.asarray(truth.object_pos[w])
            np.testing.assert_allclose(found.position[w], expected, atol=1e-6)
            normal = np.asarray(starts.targets.normal[row]) @ old @ new.T
            np.testing.assert_allclose(found.normal[w], normal, atol=1e-6)
    back = carried(local, starts.truth)
    np.testing.assert_allclose(back.position, starts.targets.position, atol=1e-6)


@pytest.mark.long
def test_the_policy_sees_the_contacts_in_the_palms_frame(scene, starts):
    """Of two ticks, the newest last, beside the closing task's numbers."""
    script, rows = moved(starts, [0, 8], 3), [0, 8]
    rng = np.random.default_rng(1)
    script.measured.palm_pos[:] += rng.normal(size=script.measured.palm_pos.shape) * 0.1
    seen = ObservationConfig(targets=True, normals=True, arm=True)
    task = make(scene, starts, script, replace(CONFIG, observation=seen))
    state, _ = begun(task, rows, 0.0)
    actions = jnp.asarray(rng.uniform(-0.1, 0.1, (3, 2, 15)), jnp.float32)
    _, out = play(task, state, actions)
    assert out.obs["state"].shape[-1] == policy_sizes(scene.robot, task.config)[0] == 66 + 2 * 25
    found = np.asarray(out.obs["state"]).reshape(3, 2, 2, 33 + 25)
    closing = ClosingTask(ScriptedPhysics(scene, script), starts, None, QUIET)
    plain = play(closing, closing.start(draw_of(rows))[0], actions)[1].obs["state"]
    np.testing.assert_array_equal(found[..., :33].reshape(3, 2, 66), plain)
    for t in range(1, 3):
        for w, row in enumerate(rows):
            for step, tick in enumerate((t - 1, t)):
                palm = script.measured.palm_mat[tick, w], script.measured.palm_pos[tick, w]
                turn = matrix(script.truth.object_quat[tick, w])
                turn = turn @ matrix(starts.truth.object_quat[row]).T
                away = starts.targets.position[row] - starts.truth.object_pos[row]
                target = np.asarray(away) @ turn.T + script.truth.object_pos[tick, w]
                normal = np.asarray(starts.targets.normal[row]) @ turn.T
                expected = np.concatenate(
                    [
                        ((target - palm[1]) @ palm[0]).ravel(),
                        (normal @ palm[0]).ravel(),
                        script.measured.q[tick, w, :7],
                    ]
                )
                np.testing.assert_allclose(found[t, w, step, 33:], expected, atol=1e-5)


@pytest.mark.long
def test_before_the_lift_actions_move_their_own_joints_alone(scene, starts):
    """Nothing guides and nothing grips, for as long as nothing lifts."""
    rows, ticks = [0] * 16, 5
    script = still(starts, rows, ticks)
    script.truth.tip_found[:, :, 0] = True  # one finger touches
    task = make(scene, starts, script)
    state, _ = begun(task, rows, 0.0)
    # World k takes action k alone, the last world none.
    actions = jnp.tile(0.2 * jnp.eye(16, 15), (ticks, 1, 1))
    after, _ = play(task, state, actions)
    at, parts = scene.addresses, task.closer.joints.at
    ctrl = np.asarray(after.physics.ctrl[-1])[:, at.robot_ctrl] - np.asarray(starts.measured.q[0])
    for k in range(15):
        joint = parts.fingers[k] if k < 9 else parts.arm_policy[k - 9]
        expected = np.zeros(ctrl.shape[1])
        expected[joint] = (5.0 if k < 9 else 0.5) * 0.2 * 0.01 * ticks
        np.testing.assert_allclose(ctrl[k], expected, atol=2e-6)
    np.testing.assert_allclose(ctrl[15], 0.0, atol=2e-6)


def test_fingers_stop_at_their_joints_limits(scene, starts):
    task = make(scene, starts, still(starts, [0], 2))
    state, _ = begun(task, [0], 0.0)
    after, _ = play(task, state, jnp.ones((400, 1, 15)).at[..., 9:].set(0.0))
    limits = task.closer.joints.limits[task.closer.joints.at.fingers]
    ctrl = after.physics.ctrl[-1, 0, scene.addresses.robot_ctrl[task.closer.joints.at.fingers]]
    np.testing.assert_allclose(ctrl, limits[:, 1], atol=1e-6)


def test_the_lift_presses_with_the_rising_grip_and_goes_up(scene, starts):
    """As in the closing task from the tick on in which all three touch."""
    script = still(starts, [0], 100)
    script.truth.tip_found[3:] = True
    grip = GripConfig(force=2.0, together=False)
    ours = make(scene, starts, script, replace(CONFIG, grip=grip))
    state, _ = begun(ours, [0], 0.0)
    closer = play(ours, state, jnp.zeros((100, 1, 15)))[0].closer
    np.testing.assert_array_equal(closer.lifting[:, 0], np.arange(100) >= 3)
    np.testing.assert_array_equal(closer.grip_ticks[:, 0, 0], np.maximum(np.arange(100) - 2, 0))
    assert (np.asarray(closer.hold[0]) == np.asarray(closer.hold[-1])).all()
    assert np.abs(np.asarray(closer.arm[-1] - closer.arm[0])).max() > 0.05


def test_assisted_it_closes_from_the_handoff_as_the_closing_task_does(scene, starts):
    """With the same actions, while the object stays; guidance is turned by nothing."""
    script, ticks = still(starts, [4], 60), 60
    script.truth.tip_found[20:] = True
    actions = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (ticks, 1, 15)), jnp.float32)
    action = ActionConfig(residual="integrated")
    helped = replace(CONFIG, assisted=True, action=action, reach_s=0.0)
    ours = make(scene, starts, script, helped)
    other = ClosingTask(
        ScriptedPhysics(scene, script), starts, ClosingTaskConfig(action=action), QUIET
    )
    a, mine = play(ours, begun(ours, [4], 0.0)[0], actions)
    b, its = play(other, other.start(draw_of([4]))[0], actions)
    np.testing.assert_allclose(a.physics.ctrl, b.physics.ctrl, atol=1e-5)
    for name in its.rewards:
        np.testing.assert_allclose(mine.rewards[name], its.rewards[name], atol=1e-4)


def test_guidance_leads_to_where_the_contact_is_now(scene, starts):
    """From far away and as the object moves: finite, no faster than it may be, and towards it."""
    rows, ticks = [0, 4, 8], 3
    script = moved(starts, rows, ticks)
    task = make(scene, starts, script)
    state, _ = begun(task, rows, 1.0)
    for t in range(ticks):
        truth = Truth(*(jnp.asarray(x[t]) for x in script.truth))
        targets = task._targets(jnp.array(rows), truth)
        field = task.closer.guidance(state.closer, state.measured, targets)
        way = targets.position - state.measured.pad_pos
        along = jnp.sum(field[..., :3] * way, -1) / jnp.linalg.norm(way, axis=-1)
        np.testing.assert_allclose(along, 0.08, rtol=1e-4)
        assert np.isfinite(field).all()
        frame = goal_frame(state.closer.goal_mat, targets.normal)
        np.testing.assert_allclose(frame[..., 0], -targets.normal, atol=1e-5)


def test_the_lift_waits_for_the_time_for_reaching(scene, starts):
    """Two touch from the first tick on; 0.2 s for reaching and 0.1 s as in the closing task."""
    script = still(starts, [0], 60)
    script.truth.tip_found[:, :, :2] = True
    stages = StageConfig(acquisition_s=0.1)
    task = make(scene, starts, script, replace(CONFIG, reach_s=0.2, stages=stages))
    state, _ = begun(task, [0], 0.0)
    states, _ = play(task, state, jnp.zeros((40, 1, 15)))
    np.testing.assert_array_equal(states.closer.lifting[:, 0], np.arange(40) >= 29)


@pytest.mark.long
def test_coming_nearer_pays_where_it_has_a_weight(scene, starts):
    script = still(starts, [0], 4)
    away = np.linspace(0.03, 0.0, 4)
    script.truth.object_pos[:, 0, 2] += away  # the contacts come down with it
    term = RewardConfig(way_left=10.0)
    task = make(scene, starts, script, replace(CONFIG, reward=term))
    assert (
        task.reward_names[-1] == "way_left"
        and "way_left" not in make(scene, starts, script).reward_names
    )
    state, _ = begun(task, [0], 0.0)
    pads = np.asarray(starts.measured.pad_pos[0])
    targets = np.asarray(starts.targets.position[0]) + np.array([0, 0, 1.0]) * away[:, None, None]
    distance = np.linalg.norm(targets - pads, axis=-1).mean(-1)
    first = np.linalg.norm(np.asarray(starts.targets.position[0]) - pads, axis=-1).mean()
    _, out = play(task, state, jnp.zeros((4, 1, 15)))
    expected = -10.0 * np.diff(np.concatenate([[first], distance]))
    np.testing.assert_allclose(out.rewards["way_left"][:, 0], expected, atol=1e-5)


@pytest.mark.long
def test_an_object_that_falls_out_of_reach_costs_no_more_than_the_way_there(scene, starts):
    script = still(starts, [0], 6)
    script.truth.object_pos[:, 0, 2] -= np.array([0.5, 2.0, 5.0, 9.0, 20.0, 0.0])
    term = RewardConfig(way_left=1.0)
    task = make(scene, starts, script, replace(CONFIG, reward=term))
    state, _ = begun(task, [0], 0.0)
    _, out = play(task, state, jnp.zeros((6, 1, 15)))
    paid = np.asarray(out.rewards["way_left"][:, 0])
    np.testing.assert_allclose(paid[2:5], 0.0, atol=1e-6)
    assert -1.0 < paid[:2].sum() < -0.9  # from a few centimetres to a metre
    np.testing.assert_allclose(paid.sum(), 0.0, atol=1e-5)  # the way alone counts


@pytest.mark.long
def test_jitted_batched_and_one_by_one_it_is_the_same(scene, starts):
    rows, ticks = [0, 4, 8], 3
    script = moved(starts, rows, ticks)
    rng = np.random.default_rng(3)
    actions = jnp.asarray(rng.uniform(-1, 1, (ticks, 3, 15)), jnp.float32)
    task = make(scene, starts, script)
    state, _ = begun(task, rows, 0.5)
    batched = play(task, state, actions)
    states, batched = batched
    eager, out = task.tick(state, actions[0])
    np.testing.assert_allclose(out.obs["state"], batched.obs["state"][0], atol=1e-5)
    np.testing.assert_allclose(eager.physics.ctrl, states.physics.ctrl[0], atol=1e-5)
    alone = make(scene, starts, Script(*jax.tree.map(lambda x: x[:, 1:2], script)))
    single = play(alone, begun(alone, rows[1:2], 0.5)[0], actions[:, 1:2])[1]
    np.testing.assert_allclose(single.obs["state"][:, 0], batched.obs["state"][:, 1], atol=1e-5)
    for name, reward in single.rewards.items():
        np.testing.assert_allclose(reward[:, 0], batched.rewards[name][:, 1], atol=1e-4)


def test_its_state_survives_being_packed(scene, starts):
    task = make(scene, starts, still(starts, [0, 4], 3))
    state, _ = begun(task, [0, 4], 0.5)
    state = state._replace(beside=state.beside._replace(level=jnp.full(2, 0.7)))
    back = task.unpack(task.pack(state))
    assert jax.tree.structure(back) == jax.tree.structure(state)
    jax.tree.map(np.testing.assert_array_equal, back, state)


def test_its_settings_are_known_by_their_kind_in_files():
    record = to_record(EndToEndConfig(reach_s=2.0, curriculum=CurriculumConfig(kind="measured")))
    read = task_from_record(record)
    assert isinstance(read, EndToEndConfig) and to_record(read) == record
    assert type(task_from_record(to_record(ClosingTaskConfig()))) is ClosingTaskConfig
    assert "kind" not in to_record(ClosingTaskConfig())
    with pytest.raises(InputError, match=r"^task\.kind: found 'reach', expected one of end_to_end"):
        task_from_record(record | {"kind": "reach"})
    with pytest.raises(InputError, match=r"^task\.curriculum\.start: found 2\.0, expected 0 to 1"):
        task_from_record(record | {"curriculum": {"start": 2.0}})
    with pytest.raises(InputError, match=r"^EndToEndConfig\.reach_s: found 9\.0.*less than"):
        EndToEndConfig(reach_s=9.0)


def test_a_world_makes_the_task_of_the_settings(scene, starts):
    world = World(scene, starts)
    assert isinstance(world.task("mujoco", 1, CONFIG), EndToEndTask)
    assert type(world.task("mujoco", 1, ClosingTaskConfig())) is ClosingTask
