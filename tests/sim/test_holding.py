"""The arm carries itself and the hand, in both engines that the package runs."""

import handmade
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.sim.mjx_engine import MjxPhysics
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import make_params
from mjx_grasp.sim.scene import build_scene

CONTROL_DT = 0.01


@pytest.mark.parametrize(
    ("engine", "seconds"),
    [
        (NativePhysics, 10.0),
        (MjxPhysics, 0.3),  # on a CPU a second takes ten
        pytest.param(MjxPhysics, 10.0, marks=pytest.mark.long),
    ],
)
def test_the_pose_is_held(robot, engine, seconds):
    scene = build_scene([handmade.box()], robot)
    at = scene.addresses
    physics = engine(scene, 1, CONTROL_DT) if engine is MjxPhysics else engine(scene, CONTROL_DT)
    qpos = np.zeros((1, scene.model.nq))
    qpos[:, at.robot_qpos] = robot.home
    qpos[:, at.object_qpos] = [0.6, -0.5, 0.045, 1, 0, 0, 0]  # on the table, out of the way
    ctrl = np.zeros((1, scene.model.nu))
    ctrl[:, at.robot_ctrl] = robot.home
    params = make_params(jnp.zeros(1, int), 0.8)

    @jax.jit
    def hold(state):
        def tick(state, _):
            state, *reported = physics.step(state, params, jnp.asarray(ctrl, jnp.float32))
            return state, reported

        return jax.lax.scan(tick, state, length=round(seconds / CONTROL_DT))[1]

    seen, truth = jax.device_get(hold(physics.init(jnp.asarray(qpos), jnp.asarray(ctrl))))
    assert len(seen.q) * CONTROL_DT == seconds
    assert not truth.tip_found.any() and not truth.overflow.any()
    drift = np.linalg.norm(seen.palm_pos - seen.palm_pos[0], axis=-1)
    assert drift.max() < 1e-3  # m; that of tests/robot/test_mjcf.py
    np.testing.assert_allclose(seen.q[-1, 0], robot.home, atol=2e-3)
    assert np.abs(seen.qd[-1]).max() < 1e-3
