"""Native MuJoCo in threads: the reference engine, and the fast one on a CPU.

The engine keeps no state of its own between calls: state goes in and comes out as arrays, through
`jax.pure_callback`, so that the same environment and the same training loop run on it as on MJX.
The worlds of an object are a `mujoco.batch.Batch`, whose threads do not wait for Python; several
objects are stepped beside each other.
"""

from __future__ import annotations

import copy
import functools
import math
import threading
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from mujoco.batch import Batch

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
_STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl")
"""MuJoCo's names of the fields of `PhysicsState`, in their order."""
_READ = (
    *("M", "qfrc_bias", "qfrc_actuator", "qfrc_passive", "nefc"),
    *("site_xpos", "site_xmat", "xaxis", "xanchor", "sensordata"),
)
_VARIED = ("geom_friction", "body_mass", "body_inertia", "body_invweight0", "body_subtreemass")
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


class NativePhysics(Physics):
    """Native MuJoCo, one model per object.

    Args:
        scene: The scene whose objects the worlds hold.
        control_dt: Control period [s].
        threads: Worker threads; by default one for each core that this process may use.
    """

    def __init__(self, scene: Scene, control_dt: float = 0.01, threads: int | None = None):
        super().__init__(scene, control_dt)
        threads = threads or usable_cores()
        self._beside = min(len(scene.objects), threads)
        self._threads = math.ceil(threads / self._beside)  # for each of those beside each other
        self._alone = threading.Lock()
        one = len(scene.objects) == 1
        self._singles = (
            [scene] if one else [build_scene([o], scene.robot, scene.config) for o in scene.objects]
        )
        self._worlds_of: dict[int, _Worlds] = {}
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
        """See `Physics.step`; worlds that do not go on cost nothing."""
        wrench = jnp.zeros((len(ctrl), 6)) if wrench is None else wrench
        worlds = state.qpos.shape[0]
        awake = jnp.ones(worlds, bool) if awake is None else awake
        shapes = {
            name: jax.ShapeDtypeStruct((worlds, *shape), dtype)
            for name, (shape, dtype) in self._readings.items()
        }
        given = state._replace(ctrl=ctrl), params, wrench, awake
        out = jax.pure_callback(self._step_host, shapes, *given, vmap_method="sequential")
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
        state, params, wrench, awake = jax.tree.map(np.asarray, (state, params, wrench, awake))
        out = {n: np.zeros((len(awake), *s), d) for n, (s, d) in self._readings.items()}

        def of_object(index: int) -> None:
            rows = np.flatnonzero(awake & (params.object_index == index))
            own = jax.tree.map(lambda x: x[rows], (state, params, wrench))
            for name, x in self._of(index, len(rows)).step(*own).items():
                out[name][rows] = x

        there = np.unique(params.object_index[awake]).tolist()
        with self._alone:  # several devices of JAX may call at once, and share the simulations
            each = map if self._beside == 1 else self._pool.map
            list(each(of_object, there))
        return out

    @functools.cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._beside, "object")

    def _of(self, index: int, count: int) -> _Worlds:
        """Room for at least so many worlds of an object."""
        found = self._worlds_of.get(index)
        if found is None or found.most < count:
            found = _Worlds(self._singles[index], self.substeps, count, self._threads)
            self._worlds_of[index] = found
        return found


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


class _Worlds:
    """Simulations of one object.

    Args:
        scene: The scene of this object alone.
        substeps: Physics steps per control tick.
        most: How many there are.
        threads: How many threads step them.
    """

    def __init__(self, scene: Scene, substeps: int, most: int, threads: int):
        self._model = model = copy.copy(scene.model)
        # A state that is not finite has to be seen, not silently put back to the default pose.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.most, self._at, self._substeps = most, scene.addresses, substeps
        # A body whose inertia is diagonal has a shorter M, so addresses differ between objects.
        self._mass_address = finger_rows(scene).address
        self._batch = batch = Batch(model, most, threads)
        self._own = {name: batch.expand(name) for name in _VARIED}
        self._data = {name: batch.bind(name) for name in (*_STATE, "xfrc_applied", *_READ)}

    def step(
        self, state: PhysicsState, params: WorldParams, wrench: Float[np.ndarray, "n 6"]
    ) -> dict[str, Shaped[np.ndarray, "n ..."]]:
        """One control tick of as many worlds as are given."""
        n, at = len(wrench), self._at
        self._vary(params)
        d = {name: x[:n] for name, x in self._data.items()}
        for name, x in zip(_STATE, state, strict=True):
            d[name][:] = x
        d["xfrc_applied"][:, at.object_body] = wrench
        full = self._times_full(n)
        ids = None if n == self.most else np.arange(n)
        each = defaultdict(list)
        for _ in range(self._substeps):
            before = d["qvel"].copy()
            self._batch.step(ids)
            each["delta_v"].append(d["qvel"] - before)
            each["mass"].append(d["M"][:, self._mass_address])
            each["bias"].append(d["qfrc_bias"].copy())
            each["applied"].append(d["qfrc_actuator"] + d["qfrc_passive"])
        joints = self._model.dof_jntid[at.robot_dof]
        site_mat, sensed = d["site_xmat"].reshape(n, -1, 3, 3), d["sensordata"]
        return {
            "qpos": d["qpos"],
            "qvel": d["qvel"],
            "warmstart": d["qacc_warmstart"],
            "palm_pos": d["site_xpos"][:, at.palm_site],
            "palm_mat": site_mat[:, at.palm_site],
            "pad_pos": d["site_xpos"][:, at.pad_sites],
            "pad_mat": site_mat[:, at.pad_sites],
            "joint_axis": d["xaxis"][:, joints],
            "joint_anchor": d["xanchor"][:, joints],
            "tip_found": sensed[:, at.tip_force[:, 0]] > 0,
            "tip_force": sensed[:, at.tip_force[:, 1:]],
            "finger_force": sensed[:, at.finger_force[:, 1:]],
            "constraints": d["nefc"],
            "overflow": self._times_full(n) > full,
        } | {name: np.stack(steps, axis=1) for name, steps in each.items()}

    def _vary(self, params: WorldParams) -> None:
        """Gives the worlds their friction and mass."""
        n, m, own = len(params.friction), self._model, self._own
        friction, scale = (x.astype(float)[:, None] for x in params[1:])
        geoms, body = self._at.object_geoms, self._at.object_body
        own["geom_friction"][:n, geoms, 0] = friction
        own["body_mass"][:n, [body]] = m.body_mass[body] * scale
        own["body_inertia"][:n, body] = m.body_inertia[body] * scale
        own["body_invweight0"][:n, body] = m.body_invweight0[body] / scale
        above = [0, body]
        added = m.body_mass[body] * (scale - 1.0)
        own["body_subtreemass"][:n, above] = m.body_subtreemass[above] + added

    def _times_full(self, n: int) -> np.ndarray:
        """How often contacts or constraints of the first worlds have not found room so far."""
        return self._batch.warning[:n, _FULL, 1].sum(axis=1)


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
