"""Targets for joint servos: simulated joints follow the integrated velocity without their lag."""

import handmade
import jax.numpy as jnp
import numpy as np

from mjx_grasp.pipeline.config import ServoConfig
from mjx_grasp.pipeline.servo import follow_velocity, joint_servos
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.sim.sim_robot import SimRobot


def moved(robot, config, ticks=60):
    """Reference and joints after a motion at constant velocity."""
    scene = build_scene([handmade.box()], robot)
    qpos = np.zeros(scene.model.nq)
    qpos[scene.addresses.robot_qpos] = robot.home
    qpos[scene.addresses.object_qpos] = (0.6, -0.5, 0.045, 1, 0, 0, 0)
    simulated = SimRobot(scene, qpos, "box")
    simulated.connect()
    servos, reference = joint_servos(robot), simulated.read().q
    velocity = jnp.full(len(robot.joints), 0.2).at[len(robot.arm.joints) :].set(0.1)
    for _ in range(ticks):
        q = simulated.read().q
        reference, target = follow_velocity(reference, q, velocity, 0.01, servos, config)
        simulated.command(np.asarray(target))
    arm = slice(0, len(robot.arm.joints))
    return np.asarray(reference)[arm], np.asarray(simulated.read().q)[arm]


def test_joints_follow_without_lag(robot):
    reference, q = moved(robot, ServoConfig())
    np.testing.assert_allclose(q, reference, atol=1.5e-3)
    behind, q = moved(robot, ServoConfig(feed_forward=0.0))
    lag = joint_servos(robot).lag[: len(q)]
    np.testing.assert_allclose(behind - q, 0.2 * lag, atol=1.5e-3)  # of half a period less


def test_a_blocked_joint_winds_nothing_up(robot):
    servos, config = joint_servos(robot), ServoConfig()
    q = reference = jnp.asarray(robot.home, jnp.float32)
    for _ in range(100):
        reference, target = follow_velocity(reference, q, jnp.ones_like(q), 0.01, servos, config)
    assert jnp.all(reference <= q + config.lead + 1e-6)
    assert jnp.all((target >= servos.lower) & (target <= servos.upper))
