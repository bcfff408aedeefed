"""MJX with Warp against native MuJoCo. Compiled once; the first run ever builds Warp's kernels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import draw_of

from mjx_grasp.errors import InputError
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.sim.mjx_engine import _STATE, MjxPhysics
from mjx_grasp.sim.physics import finger_dofs, make_params
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise

ROWS = jnp.array([0, 4, 8])


@pytest.fixture(scope="module")
def mjx_physics(scene):
    return MjxPhysics(scene, len(ROWS))


def checked(physics):
    """A compiled step for which a full buffer is an error."""
    compiled = jax.jit(physics.step)

    def step(*arguments):
        state, measured, truth = compiled(*arguments)
        assert not truth.overflow.any()
        return state, measured, truth

    return step


@pytest.fixture(scope="module")
def step(mjx_physics):
    return checked(mjx_physics)


@pytest.fixture(scope="module")
def rest(mjx_physics, starts):
    return mjx_physics.init(starts.qpos[ROWS], starts.ctrl[ROWS])


@pytest.fixture(scope="module")
def params(starts):
    return make_params(starts.object_index[ROWS], 0.8)


def ramp(scene, starts, tick):
    """Commands that close the fingers slowly: the box is squeezed from tick 20 on."""
    ctrl = np.array(starts.ctrl[ROWS])
    fingers = scene.addresses.robot_ctrl[7:19]
    ctrl[:, fingers[[3, 7, 11]]] += 0.004 * tick
    ctrl[:, fingers[[1, 5, 9]]] += np.array([-1, 1, 1]) * 0.005 * tick
    return jnp.asarray(ctrl)


@pytest.fixture(scope="module")
def runs(scene, starts, native, step, rest, params):
    """What both engines report over 40 ticks, 200 physics steps, and MJX's states."""
    native_step = jax.jit(native.step)
    state, other = rest, native.init(starts.qpos[ROWS], starts.ctrl[ROWS])
    found, expected, states = [], [], []
    for tick in range(40):
        ctrl = ramp(scene, starts, tick)
        state, *reported = step(state, params, ctrl)
        other, *reference = native_step(other, params, ctrl)
        found.append(jax.device_get(reported))
        expected.append(jax.device_get(reference))
        states.append(state)
    return found, expected, states


def part(reported, name):
    """A field of what is measured or true."""
    (whole,) = (x for x in reported if name in x._fields)
    return np.asarray(getattr(whole, name), float)


def worst(runs, name, ticks=slice(None)):
    found, expected, _ = runs
    return max(
        np.abs(part(a, name) - part(b, name)).max()
        for a, b in zip(found[ticks], expected[ticks], strict=True)
    )


def test_follows_native_before_contact_within_rounding(runs):
    first = next(t for t, (_, r) in enumerate(runs[1]) if r.tip_found.any())
    assert 10 < first < 35
    before = slice(0, first)
    assert worst(runs, "q", before) < 1e-5  # rad
    assert worst(runs, "qd", before) < 1e-3  # rad/s
    assert worst(runs, "object_pos", before) < 1e-4  # m; the dumbbell lands on the table
    assert worst(runs, "pad_pos", before) < 1e-5
    assert worst(runs, "pad_mat", before) < 1e-4
    assert worst(runs, "palm_pos", before) < 1e-5
    assert worst(runs, "joint_axis", before) < 1e-4
    assert worst(runs, "joint_anchor", before) < 1e-5
    assert worst(runs, "external_torque", before) < 1e-3  # N m


def test_follows_native_over_200_steps_with_contact(runs):
    assert sum(r.tip_found.sum() for _, r in runs[1]) >= 10
    assert worst(runs, "q") < 0.02  # rad
    assert worst(runs, "object_pos") < 1e-3  # m
    assert worst(runs, "object_quat") < 0.02
    touching = [np.array([r.tip_found for _, r in engine]) for engine in runs[:2]]
    agree = (touching[0] == touching[1]).mean()
    assert agree > 0.95
    force = [
        np.sum([np.linalg.norm(r.finger_force, axis=-1) for _, r in engine], axis=0)
        for engine in runs[:2]
    ]
    np.testing.assert_allclose(force[0], force[1], rtol=0.1, atol=0.5)


def pushed(physics, body, axis, force):
    """A step in which a body of every world is pushed along an axis [N]."""
    tick, place = physics._tick, _STATE.index("xfrc_applied")

    def with_push(*given):
        given = list(given)
        given[place] = given[place].at[:, body, axis].set(force)
        return tick(*given)

    physics._tick = with_push
    return jax.jit(lambda *given: physics.step(*given))  # not what is compiled without it


def test_external_torque_is_the_constraint_torque(scene, starts, rest, params):
    """One physics step per tick, so that Warp's own qfrc_constraint belongs to the reading."""
    physics = MjxPhysics(scene, len(ROWS), control_dt=0.002)
    step = checked(physics)
    state, seen = rest, 0.0
    for tick in range(150):
        state, measured, _ = step(state, params, ramp(scene, starts, tick / 3))
        warp = physics.on["cpu", physics.num_worlds].data
        expected = warp.qfrc_constraint.numpy()[:, finger_dofs(scene)]
        np.testing.assert_allclose(measured.external_torque[:, 0], expected, atol=3e-3)
        seen = max(seen, np.abs(expected).max())
    assert seen > 0.05
    # A known force on the index tip: its Jᵀ f comes on top.
    tip = scene.model.body(scene.robot.hand.fingers[1].tip_body).id
    _, free, _ = step(state, params, ramp(scene, starts, 50))
    _, loaded, _ = pushed(physics, tip, 1, 1.5)(state, params, ramp(scene, starts, 50))
    import mujoco

    data, jac = mujoco.MjData(scene.model), np.zeros((3, scene.model.nv))
    data.qpos[:] = state.qpos[2]
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_jac(scene.model, data, jac, None, data.xipos[tip], tip)
    expected = (jac.T @ [0, 1.5, 0])[finger_dofs(scene)]
    difference = np.asarray(loaded.external_torque - free.external_torque)[2, 0]
    assert np.abs(expected).max() > 0.05
    # Dry friction, 0.01 N m, may turn from one side to the other.
    np.testing.assert_allclose(difference, expected, atol=0.021)


@pytest.mark.parametrize(
    "buffers", [{"constraints_per_world": 8}, {"contacts_per_world": 1}], ids=["rows", "contacts"]
)
def test_full_buffers_are_reported(scene, starts, params, buffers):
    # The squeezed box needs more than one contact and the robot alone more than eight rows.
    physics = MjxPhysics(scene, len(ROWS), **buffers)
    state = physics.init(starts.qpos[ROWS], starts.ctrl[ROWS])
    _, _, truth = jax.jit(physics.step)(state, params, starts.ctrl[ROWS])
    assert truth.overflow.any()


def test_a_full_buffer_is_reported_of_its_tick_alone(scene, starts, params):
    # The robot alone has some twenty rows of constraints.
    physics = MjxPhysics(scene, len(ROWS), constraints_per_world=26)
    step, ctrl = jax.jit(physics.step), starts.ctrl[ROWS]
    held = physics.init(starts.qpos[ROWS], ctrl)
    away = physics.init(held.qpos.at[:, scene.addresses.object_qpos[2]].add(1.0), ctrl)
    found = [step(state, params, ctrl)[2].overflow for state in (away, held, away)]
    assert [bool(flags.any()) for flags in found] == [False, True, False]


def test_a_buffer_that_was_full_in_any_physics_step_is_reported(scene, starts, rest, params):
    physics = MjxPhysics(scene, len(ROWS))

    def tick(*arrays):
        found = list(original(*arrays))
        (flags,) = (k for k, x in enumerate(found) if x.dtype == jnp.int32 and x.ndim == 2)
        found[flags] |= jnp.eye(physics.substeps, len(ROWS), dtype=jnp.int32)
        return found

    original, physics._tick = physics._tick, tick
    _, _, truth = jax.jit(physics.step)(rest, params, starts.ctrl[ROWS])
    assert truth.overflow.all()


@pytest.mark.parametrize(
    ("world", "touched"),
    [(0, True), pytest.param(2, False, marks=pytest.mark.long)],
    ids=["box", "dumbbell"],
)
def test_union_world_follows_the_single_object_scene(scene, starts, robot, runs, world, touched):
    """The box is squeezed and the dumbbell lands on the table, among three objects and alone.

    They agree to rounding until the squeezed box slips in the fingers, at the end.
    """
    physics = MjxPhysics(build_scene(scene.objects[world : world + 1], robot), 1)
    step = checked(physics)
    own = slice(world, world + 1)
    state = physics.init(starts.qpos[ROWS[own]], starts.ctrl[ROWS[own]])
    alone, found = make_params(jnp.zeros(1, int), 0.8), []
    for tick in range(32):
        state, *reported = step(state, alone, ramp(scene, starts, tick)[own])
        union = runs[0][tick]
        for name in ("q", "object_pos", "object_quat"):
            difference = part(reported, name)[0] - part(union, name)[world]
            assert np.abs(difference).max() < 2e-6, (tick, name)
        found.append(bool(reported[1].tip_found.any()))
    assert any(found[:-5]) == touched


def test_friction_and_mass_act_per_world(scene, starts, mjx_physics, step, native):
    """Three boxes slide: v = v0 − μ g t whatever the mass; and each as in the native engine."""
    rows = jnp.array([0, 0, 0])
    params = make_params(jnp.zeros(3, int), jnp.array([0.1, 0.3, 0.3]), jnp.array([1.0, 1, 3]))
    dof = scene.addresses.object_dof[0]
    state = mjx_physics.init(starts.qpos[rows], starts.ctrl[rows])
    state = state._replace(qvel=state.qvel.at[:, dof].set(0.4))
    other = native.init(starts.qpos[rows], starts.ctrl[rows])
    other = other._replace(qvel=other.qvel.at[:, dof].set(0.4))
    for _ in range(6):
        state, _, truth = step(state, params, starts.ctrl[rows])
        other, _, reference = native.step(other, params, starts.ctrl[rows])
    expected = 0.4 - np.array([0.1, 0.3, 0.3]) * 9.81 * 0.06
    np.testing.assert_allclose(truth.object_vel[:, 0], expected, atol=0.02)
    np.testing.assert_allclose(truth.object_vel[:, 0], reference.object_vel[:, 0], atol=0.01)
    # The same upward force lifts the light box and not the heavy one.
    weight = scene.objects[0].mass * 9.81
    lifted = mjx_physics.init(starts.qpos[rows], starts.ctrl[rows])
    wrench = jnp.zeros((3, 6)).at[:, 2].set(2 * weight)
    lifted, _, truth = step(lifted, params, starts.ctrl[rows], wrench)
    np.testing.assert_allclose(truth.object_vel[:2, 2], 9.81 * 0.01, rtol=0.1)
    assert abs(truth.object_vel[2, 2]) < 0.01


def test_a_wrench_acts_on_the_object_as_in_the_native_engine(
    scene, starts, mjx_physics, step, rest, params, native
):
    """A force and a torque at the centre of mass, different in each world, for one tick."""
    wrench = jnp.asarray(np.random.default_rng(0).normal(size=(3, 6)) * [*[2] * 3, *[0.01] * 3])
    lifted = scene.addresses.object_qpos[2]
    states = [
        physics.init(starts.qpos[ROWS].at[:, lifted].add(0.5), starts.ctrl[ROWS])
        for physics in (mjx_physics, native)
    ]
    moved = []
    for push in (wrench, None, None):
        for k, stepped in enumerate((step, native.step)):
            states[k], _, truth = stepped(states[k], params, starts.ctrl[ROWS], push)
            moved.append(truth)
    for found, expected in zip(moved[::2], moved[1::2], strict=True):
        np.testing.assert_allclose(found.object_vel, expected.object_vel, rtol=2e-3, atol=2e-4)
        np.testing.assert_allclose(found.object_pos, expected.object_pos, atol=1e-6)
    first, second, _ = (truth.object_vel for truth in moved[::2])
    mass = np.array([scene.objects[k].mass for k in params.object_index])
    free = np.asarray(wrench[:, :3]) / mass[:, None] * 0.01 - [0, 0, 9.81 * 0.01]
    assert np.abs(first[:, 3:]).max() > 0.1, "turned too"
    np.testing.assert_allclose(second[:, :3] - first[:, :3], [[0, 0, -9.81 * 0.01]] * 3, atol=0.05)
    assert np.abs(first[:, :3] - free).max() < 0.05


def test_world_fields_are_those_of_a_model_compiled_so(mjx_physics, robot, scene):
    import handmade

    heavy = build_scene([handmade.box(mass=0.45)], robot).model
    params = make_params(jnp.array([0, 0, 1]), jnp.array([0.8, 0.4, 0.8]), jnp.array([1.0, 3, 2]))
    fields = mjx_physics.world_fields(params)
    for name in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0"):
        np.testing.assert_allclose(
            fields[name][1], getattr(heavy, name), rtol=1e-4, atol=1e-9, err_msg=name
        )
    friction = np.asarray(fields["geom_friction"])
    objects = scene.addresses.object_geoms
    np.testing.assert_allclose(friction[1, objects, 0], 0.4)
    others = np.setdiff1d(np.arange(scene.model.ngeom), objects)
    np.testing.assert_allclose(
        friction[:, others], np.broadcast_to(scene.model.geom_friction[others], (3, len(others), 3))
    )
    np.testing.assert_allclose(
        friction[..., 1:],
        np.broadcast_to(scene.model.geom_friction[:, 1:], (3, scene.model.ngeom, 2)),
        rtol=1e-6,
    )


def test_reset_restarts_bit_for_bit_and_spares_the_others(
    scene, starts, mjx_physics, step, rest, params, runs
):
    used = runs[2][30]
    mask = jnp.array([True, False, True])
    reset = mjx_physics.reset(used, mask, starts.qpos[ROWS], starts.ctrl[ROWS])
    ctrl = ramp(scene, starts, 31)
    after, _, truth = step(reset, params, ctrl)
    fresh, _, expected = step(rest, params, ctrl)
    untouched, _, untouched_truth = step(used, params, ctrl)
    for w, like, seen in (
        (0, fresh, expected),
        (2, fresh, expected),
        (1, untouched, untouched_truth),
    ):
        np.testing.assert_array_equal(after.qpos[w], like.qpos[w])
        np.testing.assert_array_equal(after.qvel[w], like.qvel[w])
        np.testing.assert_array_equal(truth.tip_force[w], seen.tip_force[w])


def test_a_stored_state_goes_on_in_worlds_that_were_elsewhere(
    scene, starts, step, rest, params, runs
):
    stored = jax.tree.map(np.asarray, runs[2][25])
    ctrl, found = ramp(scene, starts, 26), []
    for before in (runs[2][24], rest):
        step(before, params, ramp(scene, starts, 0))
        state = stored
        for _ in range(2):
            state, *reported = step(state, params, ctrl)
        found.append(reported)
    for name in ("q", "qd", "object_pos", "tip_force", "external_torque"):
        np.testing.assert_array_equal(*(part(reported, name) for reported in found))


def test_the_solver_begins_with_the_acceleration_it_is_given(scene, starts, params, runs):
    """What comes out is that of the last step; begun far from it, more iterations are needed."""
    physics, before = MjxPhysics(scene, len(ROWS), control_dt=0.002), runs[2][35]
    step, iterations = checked(physics), []
    for warmstart in (before.warmstart, jnp.full_like(before.warmstart, 1e3)):
        given = before._replace(warmstart=warmstart)
        after, _, _ = jax.block_until_ready(step(given, params, before.ctrl))
        data = physics.on["cpu", physics.num_worlds].data
        np.testing.assert_array_equal(after.warmstart, data.qacc.numpy())
        iterations.append(int(data.solver_niter.numpy().sum()))
    assert np.abs(after.warmstart).max() > 0
    assert iterations[0] < iterations[1]


def test_broken_world_is_counted_reset_and_kept(scene, starts, mjx_physics):
    task = ClosingTask(mjx_physics, starts, ClosingTaskConfig(), StartNoise(offset_m=0.0))
    env = BraxTask(task, len(ROWS), stagger=False)
    env_step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    action = jnp.zeros((len(ROWS), 15))
    for _ in range(3):
        state = env_step(state, action)
    inner = state.pipeline_state
    bad_qpos = inner.physics.qpos.at[1, 9].set(jnp.nan)
    broken = state.replace(
        pipeline_state=inner._replace(physics=inner.physics._replace(qpos=bad_qpos))
    )
    after = env_step(broken, action)
    clean = env_step(state, action)
    np.testing.assert_array_equal(after.info["broken"], [0, 1, 0])
    np.testing.assert_array_equal(after.done, [0, 1, 0])
    np.testing.assert_array_equal(after.info["truncation"], [0, 0, 0])
    np.testing.assert_array_equal(after.info["incident"]["qpos"], bad_qpos[1])
    assert after.info["incident"]["row"] == inner.episode.row[1]
    for w in (0, 2):
        np.testing.assert_array_equal(after.obs["state"][w], clean.obs["state"][w])
    for _ in range(3):
        inner = after.pipeline_state
        leaves = (after.obs, after.reward, inner.episode, inner.closer, inner.measured, inner.truth)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(leaves))
        after = env_step(after, action)
        assert not after.info["broken"].any()
    # It goes on as a world that never broke: same row, same object, same moments.
    fresh, _ = jax.jit(task.start)(draw_of(after.pipeline_state.episode.row))
    fresh = clean.replace(pipeline_state=fresh)
    assert after.info["age"][1] == after.pipeline_state.closer.tick[1] == 3
    for _ in range(3):
        fresh = env_step(fresh, action)
    assert fresh.pipeline_state.closer.tick[1] == 3
    np.testing.assert_allclose(
        after.pipeline_state.measured.q[1], fresh.pipeline_state.measured.q[1], atol=1e-5
    )


def test_no_worlds_are_refused(scene):
    with pytest.raises(InputError, match="num_worlds"):
        MjxPhysics(scene, 0)


def test_copies_of_all_worlds_are_stepped_as_one_batch(scene, starts, rest, params, mjx_physics):
    """Under vmap, one call of Warp's, and what comes out is what each copy alone would give."""
    ctrls = jnp.stack([ramp(scene, starts, tick) for tick in (3, 9, 27)])
    step = jax.jit(mjx_physics.step)
    states, many = [rest], []
    for k in range(3):
        states.append(step(states[-1], params, ramp(scene, starts, 5))[0])
        many.append(params._replace(friction=params.friction * (1.0 - 0.2 * k)))
    given = [jax.tree.map(lambda *x: jnp.stack(x), *parts) for parts in (states[1:], many)]
    together = jax.jit(jax.vmap(mjx_physics.step))(*given, ctrls)
    for k, ctrl in enumerate(ctrls):
        alone = step(states[k + 1], many[k], ctrl)
        jax.tree.map(
            lambda all_of_them, one, k=k: np.testing.assert_allclose(
                all_of_them[k], one, atol=2e-4, rtol=1e-4
            ),
            together,
            alone,
        )
    shared = jax.jit(jax.vmap(mjx_physics.step, in_axes=(None, None, 0)))(rest, params, ctrls)
    np.testing.assert_allclose(shared[0].qpos[1], step(rest, params, ctrls[1])[0].qpos, atol=2e-4)
    assert ("cpu", 3 * len(ROWS)) in mjx_physics.on
