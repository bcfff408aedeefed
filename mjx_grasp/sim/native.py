"""Native MuJoCo in threads: the reference engine, and the fast one on a CPU.

The engine keeps no state of its own between calls: state goes in and comes out as arrays, through
`jax.pure_callback`, so that the same environment and the same training loop run on it as on MJX.
"""

from __future__ import annotations

import copy
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.records.provenance import usable_cores
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import (
    Physics,
    PhysicsState,
    Truth,
    WorldParams,
    finger_rows,
    inverse_dynamics_residual,
)
from mjx_grasp.sim.scene import Scene, build_scene

_FRAMES = ("palm_pos", "palm_mat", "pad_pos", "pad_mat", "joint_axis", "joint_anchor")


class NativePhysics(Physics):
    """Native MuJoCo, one model per object and thread.

    Args:
        scene: The scene whose objects the worlds hold.
        control_dt: Control period [s].
        threads: Worker threads; by default one for each core that this process may use.
    """

    def __init__(self, scene: Scene, control_dt: float = 0.01, threads: int | None = None):
        super().__init__(scene, control_dt)
        self._threads = threads or usable_cores()
        self._pool = ThreadPoolExecutor(self._threads)
        self._alone = threading.Lock()
        singles = (
            [scene]
            if len(scene.objects) == 1
            else [build_scene([o], scene.robot, scene.config) for o in scene.objects]
        )
        self._workers = [
            [_World(copy.copy(s.model), s, self.substeps) for s in singles]
            for _ in range(self._threads)
        ]
        self._rows = finger_rows(scene)
        self._readings = _reading_shapes(scene, self.substeps)

    def step(
        self,
        state: PhysicsState,
        params: WorldParams,
        ctrl: Float[Array, "w nu"],
        wrench: Float[Array, "w 6"] | None = None,
        awake: Bool[Array, " w"] | None = None,
    ) -> tuple[PhysicsState, Measured, Truth]:
        """See `Physics.step`.

        Args:
            state: Before.
            params: Of the worlds.
            ctrl: Position commands [rad].
            wrench: On the object at its centre of mass during the tick, world frame: force [N],
                torque [N m].
            awake: Worlds that go on, all by default; what is given of the others is void.
        """
        wrench = jnp.zeros((len(ctrl), 6)) if wrench is None else wrench
        worlds = state.qpos.shape[0]
        awake = jnp.ones(worlds, bool) if awake is None else awake
        shapes = {
            name: jax.ShapeDtypeStruct((worlds, *shape), dtype)
            for name, (shape, dtype) in self._readings.items()
        }
        given = state._replace(ctrl=ctrl), params, wrench, awake
        out = jax.pure_callback(self._step_host, shapes, *given)
        state = PhysicsState(out.pop("qpos"), out.pop("qvel"), out.pop("warmstart"), ctrl)
        residual = inverse_dynamics_residual(
            self._rows,
            out.pop("mass"),
            out.pop("delta_v"),
            out.pop("bias"),
            out.pop("applied"),
            self.scene.config.physics_dt,
        )
        at = self.scene.addresses
        frames = {name: out.pop(name) for name in _FRAMES}
        measured = Measured(
            q=state.qpos[:, at.robot_qpos],
            qd=state.qvel[:, at.robot_dof],
            external_torque=residual,
            **frames,
        )
        truth = Truth(
            object_pos=state.qpos[:, at.object_qpos[:3]],
            object_quat=state.qpos[:, at.object_qpos[3:]],
            object_vel=state.qvel[:, at.object_dof],
            **out,
        )
        return state, measured, truth

    def _step_host(
        self,
        state: PhysicsState,
        params: WorldParams,
        wrench: Float[Array, "w 6"],
        awake: Bool[Array, " w"],
    ) -> dict[str, np.ndarray]:
        state, params = jax.tree.map(np.asarray, (state, params))
        wrenches, going = np.asarray(wrench), np.flatnonzero(awake).tolist()
        out = {n: np.zeros((len(awake), *s), d) for n, (s, d) in self._readings.items()}

        def run(thread: int) -> None:
            mine = self._workers[thread]
            for w in going[thread :: self._threads]:
                friction, mass_scale = float(params.friction[w]), float(params.mass_scale[w])
                world = mine[int(params.object_index[w])]
                world.step(w, state, friction, mass_scale, wrenches[w], out)

        with self._alone:  # several devices of JAX may call at once, and share the models
            list(self._pool.map(run, range(self._threads)))
        return out


def at_rest(scene: Scene, qpos: Float[np.ndarray, "n nq"], substeps: int) -> tuple[Measured, Truth]:
    """What would be measured and true if everything held still at each row.

    Args:
        scene: The scene.
        qpos: As its model has them.
        substeps: Physics steps per control tick, the width of `Measured.external_torque`.
    """
    model, at = scene.model, scene.addresses
    data = mujoco.MjData(model)
    n, f, joints = len(qpos), len(at.pad_sites), model.dof_jntid[at.robot_dof]
    sensed = sum(len(finger.joints) for finger in scene.robot.hand.fingers)
    rows: dict[str, list[np.ndarray]] = {
        k: [] for k in ("palm_pos", "palm_mat", "pad_pos", "pad_mat", "joint_axis", "joint_anchor")
    }
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        rows["palm_pos"].append(data.site_xpos[at.palm_site].copy())
        rows["palm_mat"].append(data.site_xmat[at.palm_site].reshape(3, 3).copy())
        rows["pad_pos"].append(data.site_xpos[at.pad_sites])
        rows["pad_mat"].append(data.site_xmat[at.pad_sites].reshape(f, 3, 3))
        rows["joint_axis"].append(data.xaxis[joints])
        rows["joint_anchor"].append(data.xanchor[joints])
    measured = Measured(
        q=jnp.asarray(qpos[:, at.robot_qpos], jnp.float32),
        qd=jnp.zeros((n, len(at.robot_dof)), jnp.float32),
        external_torque=jnp.zeros((n, substeps, sensed), jnp.float32),
        **{k: jnp.asarray(np.asarray(v, np.float32)) for k, v in rows.items()},
    )
    truth = Truth(
        object_pos=jnp.asarray(qpos[:, at.object_qpos[:3]], jnp.float32),
        object_quat=jnp.asarray(qpos[:, at.object_qpos[3:]], jnp.float32),
        object_vel=jnp.zeros((n, 6), jnp.float32),
        tip_found=jnp.zeros((n, f), bool),
        tip_force=jnp.zeros((n, f, 3), jnp.float32),
        finger_force=jnp.zeros((n, f, 3), jnp.float32),
        constraints=jnp.zeros(n, jnp.int32),
        overflow=jnp.zeros(n, bool),
    )
    return measured, truth


class _World:
    """One model and its data, which take the place of one world after the other."""

    def __init__(self, model: mujoco.MjModel, scene: Scene, substeps: int):
        # A state that is not finite has to be seen, not silently put back to the default pose.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._model, self._data = model, mujoco.MjData(model)
        self._at, self._substeps = scene.addresses, substeps
        # A body whose inertia is diagonal has a shorter M, so addresses differ between objects.
        self._mass_address = finger_rows(scene).address
        self._pristine = copy.copy(model)
        self._settings = (float(model.geom_friction[self._at.object_geoms[0], 0]), 1.0)

    def step(
        self,
        w: int,
        state: PhysicsState,
        friction: float,
        mass_scale: float,
        wrench: Float[np.ndarray, " 6"],
        out: dict[str, np.ndarray],
    ) -> None:
        self._apply(friction, mass_scale)
        m, d, at = self._model, self._data, self._at
        d.qpos[:] = state.qpos[w]
        d.qvel[:] = state.qvel[w]
        d.qacc_warmstart[:] = state.warmstart[w]
        d.ctrl[:] = state.ctrl[w]
        d.xfrc_applied[at.object_body] = wrench
        full = _times_full(d)
        for s in range(self._substeps):
            before = d.qvel.copy()
            mujoco.mj_step(m, d)
            out["delta_v"][w, s] = d.qvel - before
            out["mass"][w, s] = d.M[self._mass_address]
            out["bias"][w, s] = d.qfrc_bias
            out["applied"][w, s] = d.qfrc_actuator + d.qfrc_passive
        out["qpos"][w] = d.qpos
        out["qvel"][w] = d.qvel
        out["warmstart"][w] = d.qacc_warmstart
        out["palm_pos"][w] = d.site_xpos[at.palm_site]
        out["palm_mat"][w] = d.site_xmat[at.palm_site].reshape(3, 3)
        out["pad_pos"][w] = d.site_xpos[at.pad_sites]
        out["pad_mat"][w] = d.site_xmat[at.pad_sites].reshape(-1, 3, 3)
        joints = m.dof_jntid[at.robot_dof]
        out["joint_axis"][w] = d.xaxis[joints]
        out["joint_anchor"][w] = d.xanchor[joints]
        out["tip_found"][w] = d.sensordata[at.tip_force[:, 0]] > 0
        out["tip_force"][w] = d.sensordata[at.tip_force[:, 1:]]
        out["finger_force"][w] = d.sensordata[at.finger_force[:, 1:]]
        out["constraints"][w] = d.nefc
        out["overflow"][w] = _times_full(d) > full

    def _apply(self, friction: float, mass_scale: float) -> None:
        if (friction, mass_scale) == self._settings:
            return
        m, pristine, body = self._model, self._pristine, self._at.object_body
        m.geom_friction[self._at.object_geoms, 0] = friction
        m.body_mass[body] = pristine.body_mass[body] * mass_scale
        m.body_inertia[body] = pristine.body_inertia[body] * mass_scale
        m.body_invweight0[body] = pristine.body_invweight0[body] / mass_scale
        added = pristine.body_mass[body] * (mass_scale - 1.0)
        for b in (0, body):
            m.body_subtreemass[b] = pristine.body_subtreemass[b] + added
        self._settings = (friction, mass_scale)


def _times_full(data: mujoco.MjData) -> int:
    """How often contacts or constraints have not found room in the data so far."""
    warnings = mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL
    return sum(int(data.warning[w].number) for w in warnings)


def _reading_shapes(scene: Scene, substeps: int) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    m, at = scene.model, scene.addresses
    n, f = len(at.robot_dof), len(at.pad_sites)
    floats = {
        "qpos": (m.nq,),
        "qvel": (m.nv,),
        "warmstart": (m.nv,),
        "palm_pos": (3,),
        "palm_mat": (3, 3),
        "pad_pos": (f, 3),
        "pad_mat": (f, 3, 3),
        "joint_axis": (n, 3),
        "joint_anchor": (n, 3),
        "tip_force": (f, 3),
        "finger_force": (f, 3),
        "delta_v": (substeps, m.nv),
        "mass": (substeps, *finger_rows(scene).address.shape),
        "bias": (substeps, m.nv),
        "applied": (substeps, m.nv),
    }
    shapes: dict[str, tuple[tuple[int, ...], np.dtype]] = {
        name: (shape, np.dtype(np.float32)) for name, shape in floats.items()
    }
    shapes["tip_found"] = ((f,), np.dtype(bool))
    shapes["overflow"] = ((), np.dtype(bool))
    shapes["constraints"] = ((), np.dtype(np.int32))
    return shapes
