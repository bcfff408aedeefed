import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.closing import control
from mjx_grasp.closing.config import ActionConfig, GuidanceConfig, LiftConfig
from mjx_grasp.closing.joints import driven_joints

DT = 0.01
seeds = st.integers(0, 2**31)
f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731


@pytest.fixture(scope="module")
def joints(robot):
    return driven_joints(robot)


@pytest.fixture(scope="module")
def parts(joints):
    """Which joints play which part."""
    return joints.at


@pytest.fixture(scope="module")
def posed(scene, starts):
    """MuJoCo's data in the first start state, the robot moving at random; and what it measures."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = starts.qpos[0]
    at = scene.addresses
    data.qvel[at.robot_dof] = np.random.default_rng(0).normal(size=len(at.robot_dof)) * 0.3
    mujoco.mj_forward(scene.model, data)
    row = jax.tree.map(lambda x: x[0], starts.measured)
    return data, row._replace(qd=f32(data.qvel[at.robot_dof]))


def test_policy_drives_nine_finger_joints_and_six_of_the_arm(scene, joints, parts):
    order = (*scene.robot.arm.joints, *scene.robot.hand.joints)
    driven = [order[i] for i in parts.fingers]
    # Joints 2–4 of the thumb, 6–8 of the index, 10–12 of the middle finger (method §5).
    assert driven == [f"finger_r_joint{i}" for i in (2, 3, 4, 6, 7, 8, 10, 11, 12)]
    assert [order[i] for i in parts.arm_policy] == [f"joint{i}" for i in range(1, 7)]
    for finger, chain in zip(scene.robot.hand.fingers, parts.chains, strict=True):
        assert [order[i] for i in chain] == [*scene.robot.arm.joints, *finger.joints]
    np.testing.assert_array_equal(parts.per_finger.ravel(), parts.fingers)
    for i, k in enumerate(parts.fingers):
        actuator = scene.model.actuator(order[k])
        assert joints.stiffness[i] == np.float32(actuator.gainprm[0]) > 0
        assert joints.limits[k].tolist() == pytest.approx(scene.model.joint(order[k]).range)


def test_pad_and_palm_jacobians_agree_with_mujoco(scene, parts, posed):
    data, measured = posed
    model, at = scene.model, scene.addresses
    found = np.asarray(control.pad_jacobians(measured, parts.chains))
    expected = np.zeros((6, model.nv))
    for f, site in enumerate(at.pad_sites):
        mujoco.mj_jacSite(model, data, expected[:3], expected[3:], site)
        np.testing.assert_allclose(found[f], expected[:, at.robot_dof[parts.chains[f]]], atol=2e-6)
    mujoco.mj_jacSite(model, data, expected[:3], expected[3:], at.palm_site)
    palm = control.palm_jacobian(measured, parts.arm)
    np.testing.assert_allclose(palm, expected[:, at.robot_dof[parts.arm]], atol=2e-6)


def test_pad_twists_are_the_pads_velocities(scene, parts, posed):
    data, measured = posed
    found = np.asarray(control.pad_twists(measured, parts))
    velocity = np.zeros(6)
    for f, site in enumerate(scene.addresses.pad_sites):
        mujoco.mj_objectVelocity(
            scene.model, data, mujoco.mjtObj.mjOBJ_SITE, int(site), velocity, 0
        )
        np.testing.assert_allclose(found[f], [*velocity[3:], *velocity[:3]], atol=5e-6)


@given(seed=seeds)
def test_guided_rates_minimise_the_weighted_error(seed):
    rng = np.random.default_rng(seed)
    jac, field = rng.normal(size=(6, 3)) * 0.1, rng.normal(size=6) * 0.02
    w = np.array([1, 1, 1, 9e-6, 9e-6, 9e-6])
    stacked = np.concatenate([np.sqrt(w)[:, None] * jac, np.sqrt(1e-4) * np.eye(3)])
    expected = np.linalg.lstsq(stacked, np.concatenate([np.sqrt(w) * field, np.zeros(3)]))[0]
    found = control.guided_rates(f32(jac)[None], f32(field)[None], GuidanceConfig())
    np.testing.assert_allclose(found[0], np.clip(expected, -3, 3), atol=2e-3)


def test_guided_rates_are_bounded():
    jac = f32(np.eye(6)[None, :, :3] * 0.05)
    rates = control.guided_rates(jac, f32([[0.8, -0.8, 0.0, 0, 0, 0]]), GuidanceConfig())
    np.testing.assert_allclose(rates[0], [3.0, -3.0, 0.0], atol=1e-5)


@given(seed=seeds)
def test_grip_torques_do_the_work_of_the_force(seed):
    rng = np.random.default_rng(seed)
    jac, rates = rng.normal(size=(3, 6, 3)), rng.normal(size=(3, 3))
    inward, force = rng.normal(size=(3, 3)), rng.uniform(0, 5, 3)
    torque = np.asarray(control.grip_torques(f32(jac), f32(inward), f32(force)))
    velocity = np.einsum("fij,fj->fi", jac[:, :3], rates)
    power = force * (inward * velocity).sum(-1)
    np.testing.assert_allclose((torque * rates).sum(-1), power, rtol=1e-3, atol=1e-3)


def test_lift_rates_raise_the_palm_without_turning_it(parts, posed):
    _, measured = posed
    jac = control.palm_jacobian(measured, parts.arm_policy)
    rates = control.lift_rates(jac, jnp.float32(0.15), LiftConfig())
    twist = np.asarray(jac @ rates)
    np.testing.assert_allclose(twist, [0, 0, 0.15, 0, 0, 0], atol=0.01)


@given(action=st.floats(-1, 1), start=st.floats(-0.25, 0.25), limit=st.floats(0.01, 0.25))
def test_leaky_residual_follows_its_recursion(action, start, limit):
    config = ActionConfig(limit=limit)
    found = control.update_residual(jnp.full(9, start), jnp.full(9, action), DT, config)
    expected = np.clip(0.8 * start + 5.0 * 0.01 * action, -limit, limit)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_leaky_residual_is_bounded_and_returns():
    residual = jnp.zeros(9)
    for _ in range(300):
        residual = control.update_residual(residual, jnp.ones(9), DT, ActionConfig())
    np.testing.assert_allclose(residual, 0.25, atol=1e-4)
    for _ in range(60):
        residual = control.update_residual(residual, jnp.zeros(9), DT, ActionConfig())
    np.testing.assert_allclose(residual, 0.0, atol=1e-5)


def test_published_residual_integrates_the_velocity():
    config = ActionConfig(residual="integrated")
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 9))
    residual = jnp.zeros(9)
    for a in actions:
        residual = control.update_residual(residual, f32(a), DT, config)
    np.testing.assert_allclose(residual, 0.05 * actions.sum(0), atol=1e-5)


def test_landed_fingers_stay_and_the_others_do_not_run_away():
    hold, rates, config = jnp.zeros((3, 3)), jnp.ones((3, 3)), GuidanceConfig()
    landed = jnp.array([True, False, True])
    moved = control.hold_until_landed(hold, hold, rates, landed, DT, config)
    np.testing.assert_allclose(moved, np.array([[0.0] * 3, [0.01] * 3, [0.0] * 3]), atol=1e-7)
    # A joint that something stops at 0 is led by at most 0.1 rad, one way or the other.
    for sign in (1, -1):
        target = hold
        for _ in range(50):
            target = control.hold_until_landed(target, hold, sign * rates, ~landed, DT, config)
        np.testing.assert_allclose(target[0], sign * 0.1, atol=1e-6)
        np.testing.assert_array_equal(target[1], hold[1])
