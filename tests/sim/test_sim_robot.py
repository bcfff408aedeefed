"""A robot behind the protocol holds a pose, and a controller closes its hand through four verbs."""

from typing import get_type_hints

import handmade
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import CloserConfig, GripConfig
from mjx_grasp.errors import InputError
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.interface import Robot
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.sim.sim_robot import SimRobot


@pytest.fixture(scope="module")
def scene(robot):
    return build_scene([handmade.box()], robot)


def parked(scene, q, object_pose=(0.6, -0.5, 0.045, 1, 0, 0, 0)):
    """Everything's coordinates with the robot at q; the object on the table, out of the way."""
    qpos = np.zeros(scene.model.nq)
    qpos[scene.addresses.robot_qpos] = q
    qpos[scene.addresses.object_qpos] = object_pose
    return qpos


def test_it_has_what_the_protocol_asks_for(scene, robot):
    simulated = SimRobot(scene, parked(scene, robot.home), "box")
    for name in (
        *get_type_hints(Robot),
        "is_connected",
        "connect",
        "disconnect",
        "read",
        "command",
    ):
        assert hasattr(simulated, name)
    assert simulated.spec.joints == robot.joints


def test_a_pose_is_held_through_it(scene, robot):
    simulated = SimRobot(scene, parked(scene, robot.home), "box")
    simulated.connect()
    first = simulated.read()
    np.testing.assert_allclose(first.q, robot.home, atol=1e-6)
    for _ in range(200):
        simulated.command(np.array(robot.home))
    last = simulated.read()
    np.testing.assert_allclose(last.q, robot.home, atol=2e-3)
    assert np.abs(last.qd).max() < 1e-3
    assert np.linalg.norm(last.palm_pos - first.palm_pos) < 1e-3
    assert not simulated.truth().tip_found.any()
    simulated.disconnect()
    assert not simulated.is_connected


def test_a_joint_goes_where_it_is_commanded(scene, robot):
    simulated = SimRobot(scene, parked(scene, robot.home), "box")
    simulated.connect()
    target = np.array(robot.home)
    wrist, finger = len(robot.arm.joints) - 1, robot.joints.index(robot.hand.policy_joints[4])
    target[[wrist, finger]] += [0.1, 0.2]
    for _ in range(150):
        simulated.command(target)
    np.testing.assert_allclose(simulated.read().q, target, atol=0.02)


def test_the_closer_lifts_an_object_through_it(robot):
    """The loop of a real robot: read, tick, command; contact flags from nobody but the observer."""
    scene, handoffs = handmade.box_handoffs_scene()
    qpos = parked(scene, handoffs.q[0], [*handoffs.object_pos[0], *handoffs.object_quat[0]])
    simulated = SimRobot(scene, qpos, "box")
    simulated.connect()
    closer = Closer.of(simulated.spec, CloserConfig(grip=GripConfig(force=5.0)))
    targets = ThreePoints(
        jnp.asarray(handoffs.target_pos[0]), jnp.asarray(handoffs.target_normal[0])
    )
    untouched, still = jnp.zeros(3, bool), jnp.zeros(closer.action_size)
    state, tick = closer.start(simulated.read(), targets), jax.jit(closer.tick)
    for _ in range(400):
        state, target = tick(state, simulated.read(), targets, untouched, still)
        simulated.command(target)
    assert bool(state.lifting) and bool(state.landed.all())
    assert simulated.truth().object_pos[2] - handoffs.object_pos[0, 2] > 0.10


def test_what_cannot_be_is_refused(scene, robot):
    simulated = SimRobot(scene, parked(scene, robot.home), "box")
    for verb in (simulated.read, simulated.truth, lambda: simulated.command(np.array(robot.home))):
        with pytest.raises(InputError, match="connect"):
            verb()
    simulated.connect()
    for target in (np.array(robot.home[:-1]), np.full(len(robot.home), np.nan)):
        with pytest.raises(InputError, match="target"):
            simulated.command(target)
    with pytest.raises(InputError, match="qpos"):
        SimRobot(scene, np.zeros(3), "box")
    with pytest.raises(InputError, match="object"):
        SimRobot(scene, parked(scene, robot.home), "teapot")
    with pytest.raises(InputError, match="control_dt"):
        SimRobot(scene, parked(scene, robot.home), "box", control_dt=0.003)
