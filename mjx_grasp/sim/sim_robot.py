"""A simulated robot behind the protocol that a real one has."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.errors import InputError
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import NativePhysics, at_rest
from mjx_grasp.sim.physics import PhysicsState, Truth, make_params
from mjx_grasp.sim.scene import Scene


class SimRobot:
    """A robot and one object in native MuJoCo; a `Robot`. Time passes in `command`.

    Args:
        scene: Robot, table and objects.
        qpos: Where everything is when the robot is connected, as the scene's model has it.
        object_name: Which of the scene's objects is there.
        control_dt: Control period [s].
        friction: Sliding friction of the object; the scene's own if None [-].
        mass_scale: Factor on the object's mass [-].

    Raises:
        InputError: Another number of coordinates, an unknown object, or a control period that is
            no whole number of physics steps.
    """

    def __init__(
        self,
        scene: Scene,
        qpos: Float[np.ndarray, " nq"],
        object_name: str,
        control_dt: float = 0.01,
        friction: float | None = None,
        mass_scale: float = 1.0,
    ):
        if np.shape(qpos) != (scene.model.nq,) or not np.isfinite(qpos).all():
            raise InputError("qpos", np.shape(qpos), f"{scene.model.nq} finite numbers")
        self.spec, self.control_dt, self.scene = scene.robot, control_dt, scene
        self._physics = NativePhysics(scene, control_dt, threads=1)
        self._qpos = np.asarray(qpos, np.float32)
        rub = scene.config.friction[0] if friction is None else friction
        index = jnp.array([scene.object_index(object_name)])
        self._params = make_params(index, rub, mass_scale)
        self._order = np.argsort(scene.addresses.robot_ctrl)
        self._step = jax.jit(self._physics.step)
        self._state: PhysicsState | None = None

    @property
    def is_connected(self) -> bool:
        """See `Robot.is_connected`."""
        return self._state is not None

    def connect(self) -> None:
        """Puts robot and object at rest where they begin; the robot holds its posture."""
        q = self._qpos[self.scene.addresses.robot_qpos]
        qpos, ctrl = jnp.asarray(self._qpos[None]), jnp.asarray(q[None, self._order])
        self._state = self._physics.init(qpos, ctrl)
        self._seen = at_rest(self.scene, self._qpos[None], self._physics.substeps)

    def disconnect(self) -> None:
        """See `Robot.disconnect`."""
        self._state = None

    def read(self) -> Measured:
        """See `Robot.read`.

        Raises:
            InputError: The robot is not connected.
        """
        self._connected()
        return jax.tree.map(lambda x: x[0], self._seen[0])

    def truth(self) -> Truth:
        """What no real robot knows: the object and its contacts, arrays without a batch dimension.

        Raises:
            InputError: The robot is not connected.
        """
        self._connected()
        return jax.tree.map(lambda x: x[0], self._seen[1])

    def command(self, target: Float[Array | np.ndarray, " n"]) -> None:
        """See `Robot.command`; simulates the control period.

        Raises:
            InputError: The robot is not connected, or these are no targets for its joints.
        """
        state, target = self._connected(), np.asarray(target, np.float32)
        joints = len(self._order)
        if target.shape != (joints,) or not np.isfinite(target).all():
            raise InputError("target", target, f"{joints} finite joint positions [rad]")
        ctrl = jnp.asarray(target[None, self._order])
        self._state, *self._seen = self._step(state, self._params, ctrl)

    def _connected(self) -> PhysicsState:
        if self._state is None:
            raise InputError("SimRobot", "no connection", "connect() first")
        return self._state
