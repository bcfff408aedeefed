import os
from dataclasses import replace

import handmade
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.objects.model import Piece
from mjx_grasp.sim import scene as scene_module
from mjx_grasp.sim.native import NativePhysics, _Worlds
from mjx_grasp.sim.physics import (
    check_control_rate,
    finger_dofs,
    finger_rows,
    inverse_dynamics_residual,
    make_params,
)
from mjx_grasp.sim.scene import SceneConfig, build_scene

ROWS = jnp.array([0, 4, 8])


def closing_ctrl(scene, starts, rows, amount=1.0):
    """A fixed command under which the fingers close on the object."""
    ctrl = np.array(starts.ctrl[rows])
    fingers = scene.addresses.robot_ctrl[7:19]
    ctrl[:, fingers[[3, 7, 11]]] += 0.6 * amount
    ctrl[:, fingers[[2, 6, 10]]] += 0.3 * amount
    return jnp.asarray(ctrl)


def advance(physics, starts, rows, ctrl, ticks, params=None):
    params = params or make_params(starts.object_index[rows], 0.8)
    state = physics.init(starts.qpos[rows], starts.ctrl[rows])
    step = jax.jit(physics.step)
    for _ in range(ticks):
        state, *reported = step(state, params, ctrl)
    return state, *reported


def reference(model, qpos, ctrl, ticks, substeps=5):
    """The same ticks in plain MuJoCo; state rounded to float32 between ticks, as it is passed."""
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos, ctrl
    constraint = []
    for _ in range(ticks):
        for x in (data.qpos, data.qvel, data.qacc_warmstart):
            x[:] = x.astype(np.float32)
        constraint = []
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            constraint.append(data.qfrc_constraint.copy())
    return data, np.array(constraint)


@pytest.mark.overflows
def test_contacts_that_find_no_room_are_an_overflow(robot, monkeypatch):
    set_options = scene_module._set_options

    def small(spec, config):
        set_options(spec, config)
        spec.memory = 80 * 1024

    balls = [
        Piece("sphere", np.array([0.004 * k, 0.0, 0.0]), 0.02, np.zeros((0, 3))) for k in range(36)
    ]
    obj = replace(handmade.ball(), pieces=tuple(balls))
    found = {}
    for options in (small, set_options):
        monkeypatch.setattr(scene_module, "_set_options", options)
        one = build_scene([obj], robot)
        physics = NativePhysics(one, threads=1)
        qpos = np.array(one.model.qpos0, np.float32)[None]
        qpos[0, one.addresses.object_qpos[:3]] = (0.5, 0.0, 0.015)
        ctrl = jnp.zeros((1, one.model.nu))
        params = make_params(jnp.array([0]), 0.8)
        _, _, truth = physics.step(physics.init(jnp.asarray(qpos), ctrl), params, ctrl)
        found[options] = bool(truth.overflow[0])
    assert found == {small: True, set_options: False}


def test_worlds_follow_plain_mujoco(scene, starts, native, robot, handmade_objects):
    ctrl = closing_ctrl(scene, starts, ROWS)
    state, measured, truth = advance(native, starts, ROWS, ctrl, 15)
    assert truth.tip_found.any()
    for w, row in enumerate(ROWS):
        single = build_scene([handmade_objects[w]], robot)
        at = single.addresses
        single.model.geom_friction[at.object_geoms, 0] = np.float32(0.8)  # as worlds are given it
        data, constraint = reference(single.model, starts.qpos[row], ctrl[w], 15)
        for found, expected in (
            (state.qpos, data.qpos),
            (state.qvel, data.qvel),
            (state.warmstart, data.qacc_warmstart),
        ):
            np.testing.assert_array_equal(found[w], expected.astype(np.float32))
        np.testing.assert_allclose(measured.q[w], data.qpos[at.robot_qpos], atol=1e-6)
        np.testing.assert_allclose(measured.qd[w], data.qvel[at.robot_dof], atol=1e-5)
        np.testing.assert_allclose(truth.object_vel[w], data.qvel[at.object_dof], atol=1e-5)
        np.testing.assert_allclose(measured.pad_pos[w], data.site_xpos[at.pad_sites], atol=1e-6)
        np.testing.assert_allclose(
            measured.palm_mat[w].ravel(), data.site_xmat[at.palm_site], atol=1e-6
        )
        np.testing.assert_allclose(
            truth.finger_force[w], data.sensordata[at.finger_force[:, 1:]], atol=1e-4
        )
        np.testing.assert_allclose(
            truth.tip_force[w], data.sensordata[at.tip_force[:, 1:]], atol=1e-4
        )
        assert truth.constraints[w] == data.nefc
        # The inverse-dynamics residual is what the constraints did to the policy's joints.
        np.testing.assert_allclose(
            measured.external_torque[w], constraint[:, finger_dofs(single)], atol=2e-3
        )


def test_number_of_threads_changes_nothing(scene, starts):
    ctrl = closing_ctrl(scene, starts, ROWS)
    outcomes = [advance(NativePhysics(scene, threads=n), starts, ROWS, ctrl, 12) for n in (1, 3)]
    jax.tree.map(np.testing.assert_array_equal, *outcomes)


def test_worlds_that_rest_are_not_stepped_and_change_nothing(scene, starts, native, monkeypatch):
    ctrl = closing_ctrl(scene, starts, ROWS)
    params, state = (
        make_params(starts.object_index[ROWS], 0.8),
        native.init(starts.qpos[ROWS], starts.ctrl[ROWS]),
    )
    stepped, step = [], _Worlds.step

    def noted(worlds, state, *given):
        stepped.append(len(state.qpos))
        return step(worlds, state, *given)

    monkeypatch.setattr(_Worlds, "step", noted)
    every = native.step(state, params, ctrl)
    assert stepped == [1, 1, 1]  # one of each object
    stepped.clear()
    some = jax.jit(native.step)(state, params, ctrl, None, jnp.array([True, False, True]))
    assert stepped == [1, 1]
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[::2], b[::2]), every, some)


def test_more_worlds_or_fewer_than_before_are_as_from_the_start(scene, starts):
    used = NativePhysics(scene, threads=2)
    for rows in ([0], [0, 1, 2], [2, 1], [0, 8]):
        rows = jnp.array(rows)
        ctrl = closing_ctrl(scene, starts, rows)
        params = make_params(starts.object_index[rows], 0.1 * (1 + rows), 1.0 + rows)
        found, expected = (
            advance(physics, starts, rows, ctrl, 3, params)
            for physics in (used, NativePhysics(scene, threads=2))
        )
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_it_takes_the_cores_that_it_may_use_and_no_others(scene, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2, 5}, raising=False)
    native = NativePhysics(scene)
    beside, each = native._beside, native._of(0, 5)._batch.nthread
    assert beside == min(3, len(scene.objects)) and 3 <= beside * each < 3 + beside


def test_worlds_leave_no_trace_in_the_next_ones(starts, native, scene):
    """The workers' models and data are shared between worlds of different physics."""
    ctrl = closing_ctrl(scene, starts, ROWS)
    clean = advance(native, starts, ROWS, ctrl, 5)
    odd = make_params(starts.object_index[ROWS], jnp.array([0.1, 0.2, 0.3]), 3.0)
    advance(native, starts, ROWS, ctrl, 5, odd)
    jax.tree.map(np.testing.assert_array_equal, advance(native, starts, ROWS, ctrl, 5), clean)


def test_friction_acts_as_if_compiled(starts, native, scene, robot, handmade_objects):
    slippery = build_scene(handmade_objects, robot, SceneConfig(friction=(0.2, 0.02, 1e-4)))
    ctrl = closing_ctrl(scene, starts, ROWS)
    params = make_params(starts.object_index[ROWS], 0.2)
    found, *_ = advance(native, starts, ROWS, ctrl, 15, params)
    expected, *_ = advance(NativePhysics(slippery, threads=1), starts, ROWS, ctrl, 15, params)
    np.testing.assert_allclose(found.qpos, expected.qpos, atol=1e-6)
    rough, *_ = advance(native, starts, ROWS, ctrl, 15)
    assert np.abs(rough.qpos - found.qpos).max() > 1e-5


def test_mass_acts_as_if_compiled(starts, native, scene, robot):
    heavy = build_scene([handmade.box(mass=0.45)], robot)
    # box() takes its inertia from the mass, so three times the mass is three times the inertia.
    rows = jnp.array([0])
    ctrl = closing_ctrl(scene, starts, rows)
    found, *_ = advance(native, starts, rows, ctrl, 15, make_params(jnp.array([0]), 0.8, 3.0))
    expected, *_ = advance(
        NativePhysics(heavy, threads=1), starts, rows, ctrl, 15, make_params(jnp.array([0]), 0.8)
    )
    np.testing.assert_allclose(found.qpos, expected.qpos, atol=1e-6)
    light, *_ = advance(native, starts, rows, ctrl, 15)
    assert np.abs(light.qpos - found.qpos).max() > 1e-5


def test_sliding_object_is_braked_by_its_friction(starts, native):
    """v = v0 − μ g t, whatever the mass."""
    rows = jnp.array([0, 0, 0])
    params = make_params(jnp.zeros(3, int), jnp.array([0.1, 0.3, 0.3]), jnp.array([1.0, 1, 2]))
    state = native.init(starts.qpos[rows], starts.ctrl[rows])
    dof = native.scene.addresses.object_dof[0]
    state = state._replace(qvel=state.qvel.at[:, dof].set(0.4))
    step = jax.jit(native.step)
    for _ in range(6):
        state, _, truth = step(state, params, starts.ctrl[rows])
    expected = 0.4 - np.array([0.1, 0.3, 0.3]) * 9.81 * 0.06
    np.testing.assert_allclose(truth.object_vel[:, 0], expected, atol=0.02)


def test_reset_touches_the_masked_worlds_only(starts, native, scene):
    state, *_ = advance(native, starts, ROWS, closing_ctrl(scene, starts, ROWS), 5)
    mask = jnp.array([False, True, False])
    new = native.reset(state, mask, starts.qpos[:3], starts.ctrl[:3])
    fresh = native.init(starts.qpos[:3], starts.ctrl[:3])
    for w in range(3):
        jax.tree.map(
            lambda a, b, w=w: np.testing.assert_array_equal(a[w], b[w]),
            new,
            fresh if mask[w] else state,
        )


def test_a_stored_state_goes_on_bit_for_bit(starts, native, scene):
    ctrl = closing_ctrl(scene, starts, ROWS)
    params = make_params(starts.object_index[ROWS], 0.8)
    state, *_ = advance(native, starts, ROWS, ctrl, 10)
    stored = jax.tree.map(np.asarray, state)
    jax.tree.map(
        np.testing.assert_array_equal,
        native.step(state, params, ctrl),
        native.step(jax.tree.map(jnp.asarray, stored), params, ctrl),
    )


@pytest.mark.parametrize("what", ["qpos", "qvel"])
def test_world_that_is_no_number_is_not_passed_off_as_a_sound_one(starts, native, what):
    """MuJoCo resets a diverged world to its default pose by itself; that must not stay unseen."""
    params = make_params(starts.object_index[ROWS], 0.8)
    state = native.init(starts.qpos[ROWS], starts.ctrl[ROWS])
    sound, expected, _ = native.step(state, params, starts.ctrl[ROWS])
    bad = state._replace(**{what: getattr(state, what).at[1, 3].set(jnp.nan)})
    after, measured, _ = native.step(bad, params, starts.ctrl[ROWS])
    assert not np.isfinite(measured.q[1]).all()
    for w in (0, 2):
        np.testing.assert_array_equal(after.qpos[w], sound.qpos[w])
    # And the worker that met it is sound again.
    np.testing.assert_array_equal(native.step(state, params, starts.ctrl[ROWS])[1].q, expected.q)


def test_finger_rows_are_rows_of_the_full_mass_matrix(scene, starts):
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = starts.qpos[0]
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    rows = finger_rows(scene)
    np.testing.assert_array_equal(rows.dof, finger_dofs(scene))
    found = np.zeros((len(rows.dof), model.nv))
    values = data.M[rows.address] * rows.weight
    for r in range(len(rows.dof)):
        np.add.at(found[r], rows.column[r], values[r])
    np.testing.assert_allclose(found, full[rows.dof], atol=1e-7)


def test_residual_sees_an_applied_force_and_nothing_else(scene, starts, robot):
    """A known force on a fingertip in free air: Jᵀ f on its joints, less the dry friction."""
    single = build_scene([scene.objects[0]], robot)
    model, data = single.model, mujoco.MjData(single.model)
    model.dof_frictionloss[:] = 0.0
    # The thumb starts at a stop, and two proximal links touch.
    model.jnt_limited[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data.qpos[:], data.ctrl[:] = starts.qpos[0], starts.ctrl[0]
    rows = finger_rows(single)
    tip = model.body(robot.hand.fingers[1].tip_body).id
    force, free, loaded = np.array([0.3, -1.5, 0.4]), [], []
    jac = np.zeros((3, model.nv))
    for step in range(40):
        data.xfrc_applied[tip, :3] = force if step >= 20 else 0.0
        before = data.qvel.copy()
        mujoco.mj_forward(model, data)
        mujoco.mj_jac(model, data, jac, None, data.xipos[tip], tip)
        mujoco.mj_step(model, data)
        found = inverse_dynamics_residual(
            rows,
            jnp.asarray(data.M[rows.address], jnp.float32),
            jnp.asarray(data.qvel - before, jnp.float32),
            jnp.asarray(data.qfrc_bias, jnp.float32),
            jnp.asarray(data.qfrc_actuator + data.qfrc_passive, jnp.float32),
            0.002,
        )
        if step < 20:
            free.append(found)
        else:
            loaded.append(np.asarray(found) - (jac.T @ force)[rows.dof])
    assert np.abs(free).max() < 1e-3
    assert np.abs(loaded).max() < 1e-3
    assert np.abs((jac.T @ force)[rows.dof]).max() > 0.01


def test_control_period_has_to_be_whole_physics_steps(scene):
    assert check_control_rate(scene, 0.01) == 5
    assert check_control_rate(scene, 0.002) == 1
    for bad in (0.001, 0.005, 0.0):
        with pytest.raises(InputError, match="control_dt"):
            check_control_rate(scene, bad)
