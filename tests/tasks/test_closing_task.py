import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, draw_of, still

from mjx_grasp.closing.config import ActionConfig, GripConfig, GuidanceConfig
from mjx_grasp.evaluation.trials import run_trials, zero_controller
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise
from mjx_grasp.tasks.observation import policy_sizes
from mjx_grasp.tasks.success import failure_classes

QUIET = StartNoise(offset_m=0.0)
TICKS, WORLDS = 400, 16


WHOLE = {}
"""By their settings, tasks in the scene of the session, which differ in their scripts alone."""


def _whole(scene, starts, config, **settings):
    """A task without a script, and its ticks, compiled once."""
    task = ClosingTask(ScriptedPhysics(scene, ()), starts, config, QUIET, **settings)

    @jax.jit
    def ticks(script, draw, action):
        scripted = _following(task, script)

        def tick(state, _):
            state, out = scripted.tick(state, action)
            return state, (state, out)

        return jax.lax.scan(tick, scripted.start(draw)[0], length=TICKS)[1]

    return task, ticks


def _following(task, script):
    """The same task in a world that does what a script says."""
    task = copy.copy(task)
    task.physics = ScriptedPhysics(task.physics.scene, script)
    return task


def scripted_task(scene, starts, script, config=None, **settings):
    key = config or ClosingTaskConfig(), *settings.items()
    if key not in WHOLE:
        WHOLE[key] = _whole(scene, starts, key[0], **settings)
    whole, ticks = WHOLE[key]
    task = _following(whole, script)
    task.ticks = ticks
    return task


def play_script(task, rows, ticks, action):
    """The same by a script of one length for all, as its last row stays, and of as many worlds."""

    def longer(x):
        rest = [(0, TICKS - len(x)), (0, WORLDS - len(rows))] + [(0, 0)] * (x.ndim - 2)
        return jnp.asarray(np.pad(x, rest, mode="edge"))

    script = jax.tree.map(longer, task.physics.script)
    more = (0, WORLDS - len(rows))
    draw, action = draw_of(np.pad(rows, more, mode="edge")), jnp.pad(action, (more, (0, 0)))
    played = task.ticks(script, draw, action)
    return jax.tree.map(lambda x: np.asarray(x)[:ticks, : len(rows)], played)


def play(task, rows, ticks, action=None, state=None):
    """States after each tick, stacked."""
    w = len(rows)
    action = jnp.zeros((w, task.action_size)) if action is None else action
    if isinstance(task.physics, ScriptedPhysics):
        return play_script(task, rows, ticks, action)

    def tick(state, _):
        state, out = task.tick(state, action)
        return state, (state, out)

    start = jax.jit(task.start)(draw_of(rows))[0] if state is None else state
    return jax.jit(lambda s: jax.lax.scan(tick, s, length=ticks)[1])(start)


def total(out):
    """The reward of all terms."""
    return np.sum([np.asarray(term) for term in out.rewards.values()], axis=0)


def lifting_script(starts, rows, contact_tick=20, rise_tick=60, ticks=TICKS):
    """Contacts from one tick on; object and palm rise together from another."""
    script = still(starts, rows, ticks)
    script.truth.tip_found[contact_tick:] = True
    script.truth.finger_force[contact_tick:] = [0.0, 4.0, 0.0]
    for x in (script.truth.object_pos, script.measured.palm_pos):
        x[rise_tick:, :, 2] += 0.12
    return script


def test_observation_has_66_numbers_and_actions_15(scene, starts):
    task = scripted_task(scene, starts, still(starts, [0], 2))
    assert policy_sizes(scene.robot, task.config) == (66, task.action_size) == (66, 15)
    _, obs = task.start(draw_of([0]))
    assert obs["state"].shape == (1, 66)
    plain = scripted_task(scene, starts, still(starts, [0], 2), with_privileged=False)
    assert plain.start(draw_of([0]))[1].keys() == {"state"}


def test_observation_stacks_two_steps_oldest_first(scene, starts):
    script = still(starts, [0], 3)
    rng = np.random.default_rng(0)
    seen = script.measured
    seen.q[:] += rng.normal(size=seen.q.shape) * 0.01
    seen.qd[:] = rng.normal(size=seen.qd.shape) * 0.01
    task = scripted_task(scene, starts, script)
    nine = task.closer.joints.at.fingers
    state, obs = task.start(draw_of([0]))
    q0 = starts.measured.q[0, nine]
    np.testing.assert_array_equal(obs["state"][0], [*q0, *np.zeros(24)] * 2)
    actions = rng.uniform(-1, 1, (3, 1, 15)).astype(np.float32)
    steps, tick = [np.array([*q0, *np.zeros(24)])], jax.jit(task.tick)
    for t in range(3):
        state, out = tick(state, jnp.asarray(actions[t]))
        steps.append(np.concatenate([seen.q[t, 0, nine], seen.qd[t, 0, nine], actions[t, 0]]))
        np.testing.assert_allclose(out.obs["state"][0], np.concatenate(steps[-2:]), atol=1e-7)


def test_actor_is_blind_to_the_object(scene, starts):
    """Same joints, another object pose, contacts and forces: the same 66 numbers."""
    script = still(starts, [0, 0], 3)
    for x in script.truth:  # all that a robot does not measure
        x[:, 1] = ~x[:, 1] if x.dtype == bool else x[:, 1] + 1
    obs = play(scripted_task(scene, starts, script), [0, 0], 3)[1].obs
    np.testing.assert_array_equal(obs["state"][:, 0], obs["state"][:, 1])
    assert (obs["privileged_state"][:, 0] != obs["privileged_state"][:, 1]).any()


def test_actions_beyond_one_act_as_one(scene, starts):
    task = scripted_task(scene, starts, still(starts, [0, 0], 3))
    actions = jnp.stack([jnp.full(15, 50.0), jnp.ones(15)])
    ctrl = play(task, [0, 0], 3, actions)[0].physics.ctrl
    np.testing.assert_array_equal(ctrl[:, 0], ctrl[:, 1])


def test_actions_move_their_own_joints_by_the_published_amounts(scene, starts):
    config = ClosingTaskConfig(action=ActionConfig(residual="integrated"))
    task = scripted_task(scene, starts, still(starts, [0] * 16, 3), config)
    at, parts = scene.addresses, task.closer.joints.at
    # World k takes action k alone, the last world none.
    actions = jnp.eye(16, 15) * 0.5
    ctrl = np.asarray(play(task, [0] * 16, 1, actions)[0].physics.ctrl[0])
    for k in range(15):
        joint = parts.fingers[k] if k < 9 else parts.arm_policy[k - 9]
        expected = np.zeros(ctrl.shape[1])
        expected[at.robot_ctrl[joint]] = (5.0 if k < 9 else 0.15) * 0.5 * 0.01
        np.testing.assert_allclose(ctrl[k] - ctrl[15], expected, atol=1e-6)


def test_three_contacts_start_the_lift_at_once(scene, starts):
    task = scripted_task(scene, starts, lifting_script(starts, [0], contact_tick=7))
    states, _ = play(task, [0], 40)
    np.testing.assert_array_equal(states.closer.lifting[:, 0], np.arange(40) >= 7)
    assert states.closer.landed[:7].sum() == 0 and states.closer.landed[7:].all()


def test_two_contacts_wait_for_1_6_seconds_and_one_never_lifts(scene, starts):
    script = still(starts, [0, 0], TICKS)
    script.truth.tip_found[10:, 0, :2] = True
    script.truth.tip_found[10:, 1, :1] = True
    states, _ = play(scripted_task(scene, starts, script), [0, 0], TICKS)
    # Tick 159 is the one after which 1.6 s have passed.
    np.testing.assert_array_equal(states.closer.lifting[:, 0], np.arange(TICKS) >= 159)
    assert not states.closer.lifting[:, 1].any()


def test_observer_alone_can_land_fingers_and_start_the_lift(scene, starts):
    script = still(starts, [0], 30)
    script.measured.external_torque[5:] = 0.3
    states, out = play(scripted_task(scene, starts, script), [0], 30)
    lifting = np.asarray(states.closer.lifting[:, 0])
    assert lifting[-1] and 7 <= lifting.argmax() <= 9  # three ticks in a row
    # The reward counts the solver's contacts: what the observer takes for one pays nothing.
    np.testing.assert_allclose(total(out)[-1], 2.0, rtol=1e-5)


def test_scripted_lift_commands_the_palm_up_by_its_height(scene, starts):
    """Arm commands integrated with the palm's Jacobian, the arm standing still in the script."""
    task = scripted_task(scene, starts, lifting_script(starts, [0], contact_tick=0))
    states, _ = play(task, [0], 200)
    at = scene.addresses
    moved = states.closer.arm[-1, 0] - states.closer.arm[0, 0]
    from mjx_grasp.closing import control

    first, arm = jax.tree.map(lambda x: x[0], starts.measured), task.closer.joints.at.arm
    jac = control.palm_jacobian(first, arm)
    rise = np.asarray(jac @ moved)
    np.testing.assert_allclose(rise[2], 0.15, rtol=0.05)
    np.testing.assert_allclose(rise[[0, 1]], 0.0, atol=0.01)
    ctrl = states.physics.ctrl[:, 0, at.robot_ctrl[arm]]
    np.testing.assert_allclose(ctrl, states.closer.arm[:, 0], atol=1e-6)
    assert (ctrl[:, 6] == ctrl[0, 6]).all()  # joint 7 is held


def test_landed_finger_is_held_and_pushed_with_the_grip_force(scene, starts):
    script = still(starts, [0], 120)
    script.truth.tip_found[10:, 0, 1] = True  # the index alone
    config = ClosingTaskConfig(grip=GripConfig(force=2.0, together=False, approach_s=9.0))
    task = scripted_task(scene, starts, script, config)
    states, _ = play(task, [0], 120)
    hold = np.asarray(states.closer.hold[:, 0])
    assert (hold[11:, 1] == hold[11, 1]).all()
    assert (hold[11:, 0] != hold[10, 0]).any()
    at, joints = scene.addresses, task.closer.joints
    fingers = at.robot_ctrl[joints.at.fingers]
    ctrl = np.asarray(states.physics.ctrl[:, 0, fingers]).reshape(-1, 3, 3)
    push = (ctrl - hold) * joints.stiffness.reshape(3, 3)
    assert np.abs(push[:, [0, 2]]).max() < 1e-5
    # Jᵀ(F·n_inward) of MuJoCo's own Jacobian.
    import mujoco

    data = mujoco.MjData(scene.model)
    data.qpos[:] = starts.qpos[0]
    mujoco.mj_forward(scene.model, data)
    jac = np.zeros((3, scene.model.nv))
    mujoco.mj_jacSite(scene.model, data, jac, None, at.pad_sites[1])
    dofs = at.robot_dof[joints.at.per_finger[1]]
    expected = jac[:, dofs].T @ (2.0 * -np.asarray(starts.targets.normal[0, 1]))
    np.testing.assert_allclose(push[-1, 1], expected, atol=2e-5)
    np.testing.assert_allclose(push[10 + 26, 1], expected * 0.5, rtol=0.05, atol=1e-4)
    assert np.abs(push[:11]).max() < 1e-5


def test_fingers_grip_together_or_when_the_approach_has_taken_too_long(scene, starts):
    """World 0: one lands at tick 10, the others at 40; world 1: one lands, the others never."""
    script = still(starts, [0, 0], 130)
    script.truth.tip_found[10:, :, 1] = True
    script.truth.tip_found[40:, 0] = True
    states, _ = play(scripted_task(scene, starts, script), [0, 0], 130)
    ticks = np.asarray(states.closer.grip_ticks)
    assert (ticks == ticks[..., :1]).all()
    np.testing.assert_array_equal(ticks[:, 0, 0], np.maximum(np.arange(130) - 39, 0))
    np.testing.assert_array_equal(ticks[:, 1, 0], np.maximum(np.arange(130) - 99, 0))


def test_finger_that_arrives_without_touching_grips(scene, starts):
    """At the contact itself; 4 mm before it; 8 mm before it."""
    script = still(starts, [0, 0, 0], 4)
    goal = starts.targets.position[0]
    way = goal - starts.measured.pad_pos[0]
    unit = way / np.linalg.norm(way, axis=-1, keepdims=True)
    for w, left in enumerate((0.0, 0.004, 0.008)):
        script.measured.pad_pos[:, w] = goal - left * unit
    states, _ = play(scripted_task(scene, starts, script), [0, 0, 0], 4)
    np.testing.assert_array_equal(states.closer.grip_ticks[-1, :, 0], [4, 4, 0])


OUTCOMES = ("held", "late", "slipped", "dropped", "left", "carried")


@pytest.fixture(scope="module")
def outcomes(scene, starts):
    """Trials of scripted worlds, one per name."""
    script = lifting_script(starts, [0] * len(OUTCOMES))
    world = {name: w for w, name in enumerate(OUTCOMES)}
    late = lifting_script(starts, [0], TICKS - 2, TICKS - 1)
    for whole, one in zip(jax.tree.leaves(script), jax.tree.leaves(late), strict=True):
        whole[:, world["late"]] = one[:, 0]
    places = (script.truth.object_pos, script.measured.palm_pos)
    script.truth.object_pos[80:, world["slipped"], 1] += 0.031
    for x in places:
        x[80:, world["dropped"]] = x[0, world["dropped"]]
    script.truth.object_pos[60:, world["left"], 2] -= 0.03
    # Pushed before the lift, then turned together with the palm.
    w = world["carried"]
    script.truth.object_pos[10:, w, 0] += 0.05
    c, s = np.cos(0.6), np.sin(0.6)
    T = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    for x in places:
        x[100:, w] = x[100:, w] @ T.T
    script.measured.palm_mat[100:, w] = T @ script.measured.palm_mat[100:, w]
    task = scripted_task(scene, starts, script)
    trials = run_trials(task, zero_controller(task), draw_of([0] * len(OUTCOMES)), len(OUTCOMES))
    return {name: type(trials)(*(x[w] for x in trials)) for name, w in world.items()}


@pytest.mark.parametrize(
    "name, expected",
    [
        ("held", "success"),
        ("late", "not_held"),
        ("slipped", "slipped"),
        ("dropped", "not_held"),
        ("left", "never_lifted"),
        # Displacement counts from lift onset and in the palm's frame.
        ("carried", "success"),
    ],
)
def test_trials_fall_into_their_class(outcomes, name, expected):
    classes = ("success", "slipped", "not_held", "never_lifted")
    assert [c for c in classes if getattr(outcomes[name], c)] == [expected]


@pytest.mark.parametrize("name", ["held", "late"])
def test_force_is_the_mean_and_the_peak_since_lift_onset(outcomes, name):
    """Every tick from lift onset on has 4 N on each finger."""
    np.testing.assert_allclose(outcomes[name].force_peak, 4.0, rtol=1e-5)
    np.testing.assert_allclose(outcomes[name].force_mean, 4.0, rtol=1e-4)


def test_force_counts_every_finger_and_only_from_lift_onset_on(scene, starts):
    """The mean over fingers and ticks, and the one finger that ever pressed hardest."""
    script = lifting_script(starts, [0])
    norms = np.random.default_rng(0).uniform(1.0, 5.0, (TICKS, 3)).astype(np.float32)
    norms[10] = 50.0  # before the lift
    norms[100] = [7.0, 30.0, 7.0]
    direction = np.array([0.48, -0.6, 0.64], np.float32)
    script.truth.finger_force[:, 0] = norms[..., None] * direction
    task = scripted_task(scene, starts, script)
    trials = run_trials(task, zero_controller(task), draw_of([0]), 1)
    np.testing.assert_allclose(trials.force_mean, norms[20:].mean(), rtol=1e-4)
    np.testing.assert_allclose(trials.force_peak, 30.0, rtol=1e-5)


def test_peak_rise_is_reported(outcomes):
    np.testing.assert_allclose(outcomes["held"].peak_rise, 0.12, atol=1e-5)


def test_reward_of_each_stage_on_a_hand_made_state(scene, starts):
    script = lifting_script(starts, [0], contact_tick=5, rise_tick=400)
    _, out = play(scripted_task(scene, starts, script), [0], 200)
    reward = total(out)[:, 0]
    # Acquiring, standing still: 3·mean exp(−|GVF|/(0.5(|GVF| + 0.02))).
    from mjx_grasp.closing.guidance import goal_frame, guidance_field

    r, targets = jax.tree.map(lambda x: x[0], (starts.measured, starts.targets))
    goal = goal_frame(r.pad_mat, targets.normal)
    field = np.asarray(
        guidance_field(r.pad_pos, r.pad_mat, r.pad_pos, targets.position, goal, GuidanceConfig())
    )
    size = np.sqrt((field[:, :3] ** 2).sum(-1) + 0.05**2 * (field[:, 3:] ** 2).sum(-1))
    reach = 3.0 * np.exp(-size / (0.5 * (size + 0.02))).mean()
    np.testing.assert_allclose(reward[:5], reach, rtol=1e-3)
    np.testing.assert_allclose(reward[5], reach + 3.0, rtol=1e-3)
    # Lifting at rest: 2·exp(−(v*/0.1)²) + 3; before the script's motion and after it, 2 + 3.
    np.testing.assert_allclose(reward[[30, 50]], 5.0, rtol=1e-4)
    np.testing.assert_allclose(reward[100], 3.0 + 2.0 * np.exp(-(1.5**2)), rtol=1e-3)
    np.testing.assert_allclose(reward[190], 5.0, rtol=1e-4)


def test_world_that_is_no_number_is_reported_and_earns_nothing(scene, starts):
    script = still(starts, [0, 1], 3)
    script.measured.q[1:, 1] = script.measured.qd[1:, 1] = np.nan
    _, out = play(scripted_task(scene, starts, script), [0, 1], 3)
    np.testing.assert_array_equal(out.broken, [[False, False], [False, True], [False, True]])
    for term in out.rewards.values():
        np.testing.assert_array_equal(term[1:, 1], 0.0)
        assert np.isfinite(term).all()
    assert np.isfinite(out.obs["state"][:, 0]).all()


def test_reset_touches_the_masked_worlds_only(scene, starts, native):
    task = ClosingTask(native, starts, ClosingTaskConfig(), QUIET)
    rows = [0, 3, 6, 1]
    before = jax.tree.map(lambda x: x[-1], play(task, rows, 12)[0])
    mask = jnp.array([False, True, False, True])
    draw = draw_of([2, 4, 5, 8])
    after, obs = jax.jit(task.reset)(before, mask, draw)
    fresh, fresh_obs = jax.jit(task.start)(draw)
    for w in range(4):
        expected = fresh if mask[w] else before
        jax.tree.map(lambda a, b, w=w: np.testing.assert_array_equal(a[w], b[w]), after, expected)
    for name in obs:
        np.testing.assert_array_equal(obs[name][1], fresh_obs[name][1])


def test_world_that_was_reset_goes_on_as_a_fresh_one(starts, native):
    task = ClosingTask(native, starts, ClosingTaskConfig(), QUIET)
    used = jax.tree.map(lambda x: x[-1], play(task, [0, 3], 15)[0])
    draw = draw_of([1, 4])
    reset, _ = jax.jit(task.reset)(used, jnp.ones(2, bool), draw)
    action = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (2, 15)), jnp.float32)
    again = play(task, [1, 4], 10, action, state=reset)
    fresh = play(task, [1, 4], 10, action)
    jax.tree.map(np.testing.assert_array_equal, again, fresh)


@pytest.mark.long
def test_worlds_together_agree_with_worlds_alone(starts, native):
    task = ClosingTask(native, starts, ClosingTaskConfig(), QUIET)
    rows = [0, 4, 8]
    action = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (3, 15)), jnp.float32)
    together = play(task, rows, 8, action)[1]
    for w, row in enumerate(rows):
        alone = play(task, [row], 8, action[w : w + 1])[1]
        jax.tree.map(
            lambda a, b, w=w: np.testing.assert_allclose(a[:, w], b[:, 0], atol=2e-5),
            (together.obs["state"], together.rewards),
            (alone.obs["state"], alone.rewards),
        )


@pytest.mark.long
def test_jit_agrees_with_eager(starts, native):
    task = ClosingTask(native, starts, ClosingTaskConfig(), QUIET)
    action = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (2, 15)), jnp.float32)
    state, _ = task.start(draw_of([0, 7]))
    jitted = play(task, [0, 7], 4, action)[1]
    for t in range(4):
        state, out = task.tick(state, action)
        np.testing.assert_allclose(out.obs["state"], jitted.obs["state"][t], atol=1e-5)
        np.testing.assert_allclose(
            out.obs["privileged_state"], jitted.obs["privileged_state"][t], atol=1e-4
        )
        for name, term in out.rewards.items():
            np.testing.assert_allclose(term, jitted.rewards[name][t], atol=1e-4)


def test_turning_the_scene_about_the_vertical_changes_nothing(starts, native):
    """Rows 0–2 are the same state, turned about the arm's base."""
    task = ClosingTask(native, starts, ClosingTaskConfig(grip=GripConfig(force=5.0)), QUIET)
    states, out = play(task, [0, 1, 2], 60)
    for w in (1, 2):
        np.testing.assert_allclose(total(out)[:, w], total(out)[:, 0], atol=5e-3)
        np.testing.assert_allclose(out.obs["state"][:, w], out.obs["state"][:, 0], atol=2e-3)
        np.testing.assert_array_equal(states.closer.lifting[:, w], states.closer.lifting[:, 0])


def test_squeeze_lifts_a_box_and_too_little_force_lets_it_slip(starts, native):
    """The whole chain once, in the reference engine: 5 N hold 1.5 N of weight, 1 N does not."""
    outcome = {}
    for force in (1.0, 5.0):
        task = ClosingTask(native, starts, ClosingTaskConfig(grip=GripConfig(force=force)), QUIET)
        states, _ = play(task, [0, 1], TICKS)
        last = jax.tree.map(lambda x: x[-1], states.episode)
        outcome[force] = np.asarray(last.progress.success)
        classes = failure_classes(last.progress)
        total = sum(np.asarray(c).astype(int) for c in classes.values()) + outcome[force]
        np.testing.assert_array_equal(total, 1)
        assert last.force_peak.max() < 20.0
    assert outcome[5.0].all() and not outcome[1.0].any()


def test_what_a_grip_feels_is_what_the_contact_solver_says(starts, native):
    """The whole chain of an answering grip: torques, forces, level, lift; and with less force."""
    gentle = GripConfig(force=1.0, split="balanced", direction="line", follow=0.05, friction=0.5)
    task = ClosingTask(native, starts, ClosingTaskConfig(grip=gentle), QUIET)
    states, _ = play(task, [0, 1], TICKS)
    felt = jax.jit(jax.vmap(task.closer.forces))(states.closer, states.measured)
    felt, true = (np.linalg.norm(x, axis=-1) for x in (felt, states.truth.finger_force))
    pressed = np.asarray(states.closer.lifting)[..., None] & (true > 0.5)
    assert pressed.mean() > 0.3
    assert np.median(np.abs(felt - true)[pressed]) < 0.5
    assert np.asarray(states.episode.progress.success)[-1].all()
    level = np.asarray(states.closer.level)
    assert level[0].max() == 1.0 and 1.0 < level.max() < 5.0
