"""MJX with `impl='warp'`: the training engine, on a GPU; it also runs on a CPU, slowly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from mjx_grasp.errors import InputError
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import (
    Truth,
    WorldParams,
    check_control_rate,
    finger_rows,
    inverse_dynamics_residual,
)
from mjx_grasp.sim.scene import ObjectFields, Scene

_STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "time")


class MjxPhysics:
    """Worlds of the union scene in MuJoCo Warp, called from JAX.

    Args:
        scene: The scene; every world may hold any of its objects.
        num_worlds: Worlds that are stepped together.
        control_dt: Control period [s].
        contacts_per_world: Size of the shared contact buffer, per world.
        constraints_per_world: Constraint rows a world may use.
    """

    def __init__(
        self,
        scene: Scene,
        num_worlds: int,
        control_dt: float = 0.01,
        contacts_per_world: int = 24,
        constraints_per_world: int = 128,
    ):
        if num_worlds < 1:
            raise InputError("num_worlds", num_worlds, "at least 1")
        self.scene, self.num_worlds = scene, num_worlds
        self.substeps = check_control_rate(scene, control_dt)
        # Warp would print a line per world whose line search stops early; Truth has overflows.
        quiet = {"opt._impl.warn_overflow": 0}
        # By default MJX takes the first of all devices, which may be another process's.
        self._device = jax.local_devices()[0]
        model = mjx.put_model(scene.model, impl="warp", device=self._device)
        self._model = model.tree_replace(quiet)
        self.buffers = dict(naconmax=contacts_per_world * num_worlds, njmax=constraints_per_world)
        self._rows = finger_rows(scene)
        names = (*ObjectFields.NAMES, "geom_friction")
        self._axes = jax.tree.map(lambda _: None, self._model).tree_replace(dict.fromkeys(names, 0))
        at = scene.addresses
        self._joints = scene.model.dof_jntid[at.robot_dof]
        body_mask = np.zeros((scene.model.nbody, 1), np.float32)
        body_mask[at.object_body] = 1.0
        self._is_object = body_mask
        self._mass_adds_to = body_mask[:, 0] + (np.arange(scene.model.nbody) == 0)
        geom_mask = np.zeros((scene.model.ngeom, 1), np.float32)
        geom_mask[at.object_geoms, 0] = 1.0
        self._slides = geom_mask * np.array([[1.0, 0.0, 0.0]], np.float32)

    def init(self, qpos: Float[Array, "w nq"], ctrl: Float[Array, "w nu"]) -> mjx.Data:
        """See `Physics.init`."""
        model, on = self.scene.model, self._device
        one = mjx.make_data(model, device=on, impl="warp", **self.buffers)
        data = jax.vmap(lambda q, c: one.replace(qpos=q, ctrl=c))(
            jnp.asarray(qpos, jnp.float32), jnp.asarray(ctrl, jnp.float32)
        )
        # One step on a copy gives every array its batched shape, so that a scan can carry it;
        # then the state is put back.
        params = WorldParams(
            jnp.zeros(self.num_worlds, jnp.int32),
            jnp.full(self.num_worlds, self.scene.config.friction[0]),
            jnp.ones(self.num_worlds),
        )
        warm = jax.vmap(mjx.step, in_axes=(self._axes, 0))(
            self._model.tree_replace(self.world_fields(params)), data
        )
        return self.reset(warm, jnp.ones(self.num_worlds, bool), qpos, ctrl)

    def reset(
        self,
        state: mjx.Data,
        mask: Bool[Array, " w"],
        qpos: Float[Array, "w nq"],
        ctrl: Float[Array, "w nu"],
    ) -> mjx.Data:
        """See `Physics.reset`."""

        def put(new: Array | float, old: Array) -> Array:
            return jnp.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        return state.replace(
            qpos=put(qpos, state.qpos),
            qvel=put(0.0, state.qvel),
            ctrl=put(ctrl, state.ctrl),
            qacc_warmstart=put(0.0, state.qacc_warmstart),
            time=put(0.0, state.time),
        )

    def step(
        self, state: mjx.Data, params: WorldParams, ctrl: Float[Array, "w nu"]
    ) -> tuple[mjx.Data, Measured, Truth]:
        """See `Physics.step`."""
        models = self._model.tree_replace(self.world_fields(params))
        step = jax.vmap(mjx.step, in_axes=(self._axes, 0))
        data = state.replace(ctrl=ctrl)
        residuals, overflow = [], jnp.zeros(self.num_worlds, bool)
        for _ in range(self.substeps):
            before = data.qvel
            data = step(models, data)
            residuals.append(
                inverse_dynamics_residual(
                    self._rows,
                    data._impl.M[:, self._rows.address],
                    data.qvel - before,
                    data.qfrc_bias,
                    data.qfrc_actuator + data.qfrc_passive,
                    self.scene.config.physics_dt,
                )
            )
            overflow |= _buffer_overflow(data)
        return data, self._measured(data, jnp.stack(residuals, axis=1)), self._truth(data, overflow)

    def pack(self, state: mjx.Data) -> dict[str, Array]:
        """See `Physics.pack`."""
        return {name: getattr(state, name) for name in _STATE}

    def unpack(self, packed: dict[str, Array]) -> mjx.Data:
        """See `Physics.unpack`."""
        return self.init(packed["qpos"], packed["ctrl"]).replace(**packed)

    def world_fields(self, params: WorldParams) -> dict[str, Array]:
        """Model fields of each world: its own object, friction and mass, [w, ...] each."""
        table = self.scene.object_fields
        rows = {
            name: jnp.asarray(getattr(table, name), jnp.float32)[params.object_index]
            for name in ObjectFields.NAMES
        }
        scale = params.mass_scale[:, None]
        change = 1.0 + self._is_object[:, 0] * (scale - 1.0)
        object_mass = rows["body_mass"][:, self.scene.addresses.object_body, None]
        rows["body_subtreemass"] += self._mass_adds_to * object_mass * (scale - 1.0)
        rows["body_mass"] *= change
        rows["body_inertia"] *= change[..., None]
        rows["body_invweight0"] /= change[..., None]
        base = jnp.asarray(self.scene.model.geom_friction, jnp.float32)
        rows["geom_friction"] = base + self._slides * (params.friction[:, None, None] - base)
        return rows

    def _measured(self, data: mjx.Data, residual: Float[Array, "w s m"]) -> Measured:
        at = self.scene.addresses
        mats = data.site_xmat.reshape(self.num_worlds, -1, 3, 3)
        return Measured(
            q=data.qpos[:, at.robot_qpos],
            qd=data.qvel[:, at.robot_dof],
            external_torque=residual,
            palm_pos=data.site_xpos[:, at.palm_site],
            palm_mat=mats[:, at.palm_site],
            pad_pos=data.site_xpos[:, at.pad_sites],
            pad_mat=mats[:, at.pad_sites],
            joint_axis=data.xaxis[:, self._joints],
            joint_anchor=data.xanchor[:, self._joints],
        )

    def _truth(self, data: mjx.Data, overflow: Bool[Array, " w"]) -> Truth:
        at = self.scene.addresses
        return Truth(
            object_pos=data.qpos[:, at.object_qpos[:3]],
            object_quat=data.qpos[:, at.object_qpos[3:]],
            object_vel=data.qvel[:, at.object_dof],
            tip_found=data.sensordata[:, at.tip_force[:, 0]] > 0,
            tip_force=data.sensordata[:, at.tip_force[:, 1:]],
            finger_force=data.sensordata[:, at.finger_force[:, 1:]],
            constraints=data._impl.nefc.reshape(self.num_worlds),
            overflow=overflow,
        )


def _buffer_overflow(data: mjx.Data) -> Bool[Array, " w"]:
    """Whether a contact or constraint did not fit; reaching the iteration limit is no overflow."""
    overflow = mujoco.mjx.third_party.mujoco_warp.OverflowType
    full = int(overflow.NEFC | overflow.NJMAX_NNZ | overflow.BROADPHASE | overflow.NARROWPHASE)
    return (data._impl.overflow & full) != 0
