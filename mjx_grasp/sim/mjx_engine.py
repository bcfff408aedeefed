"""MuJoCo Warp, as MJX ships it, called from JAX: the training engine, on a GPU; slowly on a CPU.

MJX's own step hands all of Warp's arrays, a few hundred, in and out of JAX at every physics step.
Here they stay with Warp: what goes in and out is the worlds' state, and what is measured of them,
once per control tick. On a GPU the tick's physics steps are one CUDA graph, captured once. Under
`jax.vmap` the worlds of all copies are stepped together.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco.mjx.third_party.mujoco_warp as mjw
import numpy as np
import warp as wp
from jaxtyping import Array, Bool, Float

from mjx_grasp.errors import InputError
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import (
    Physics,
    PhysicsState,
    Truth,
    WorldParams,
    finger_rows,
    inverse_dynamics_residual,
)
from mjx_grasp.sim.scene import ObjectFields, Scene

# Warp's names of what goes in: the state, and the model's fields that differ between worlds;
_STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "xfrc_applied")
_FIELDS = (*ObjectFields.NAMES, "geom_friction")
# of what comes out: as the last physics step leaves it, and as each step does.
_FRAMES = ("site_xpos", "site_xmat", "xaxis", "xanchor")
_LAST = ("qpos", "qacc_warmstart", *_FRAMES, "sensordata", "nefc")
_EACH = ("qvel", "M", "qfrc_bias", "qfrc_actuator", "qfrc_passive", "overflow")
# A contact or constraint that did not fit; reaching the iteration limit is no overflow.
_FULL = mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ
_FULL |= mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD
_FULL |= mjw.OverflowType.CONTACT_MATCH

_CONTACTS, _CONSTRAINTS = 24, 128
"""Room for so many contacts of a world on average, and for constraint rows of each."""


class MjxPhysics(Physics):
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
        contacts_per_world: int = _CONTACTS,
        constraints_per_world: int = _CONSTRAINTS,
    ):
        super().__init__(scene, control_dt)
        if num_worlds < 1:
            raise InputError("num_worlds", num_worlds, "at least 1")
        self.num_worlds = num_worlds
        self.buffers = _buffers(num_worlds, contacts_per_world, constraints_per_world)
        self._rows = finger_rows(scene)
        self.on: dict[tuple[str, int], WarpWorlds] = {}
        """Warp's own arrays by device and number of worlds, as the last tick left them"""
        self._tick = _function(self, num_worlds)
        at = scene.addresses
        self._joints = scene.model.dof_jntid[at.robot_dof]
        body_mask = np.zeros((scene.model.nbody, 1), np.float32)
        body_mask[at.object_body] = 1.0
        self._is_object = body_mask
        self._mass_adds_to = body_mask[:, 0] + (np.arange(scene.model.nbody) == 0)
        geom_mask = np.zeros((scene.model.ngeom, 1), np.float32)
        geom_mask[at.object_geoms, 0] = 1.0
        self._slides = geom_mask * np.array([[1.0, 0.0, 0.0]], np.float32)

    def step(
        self,
        state: PhysicsState,
        params: WorldParams,
        ctrl: Float[Array, "w nu"],
        wrench: Float[Array, "w 6"] | None = None,
        awake: Bool[Array, " w"] | None = None,
    ) -> tuple[PhysicsState, Measured, Truth]:
        """See `Physics.step`; worlds that do not go on are stepped all the same."""
        fields = self.world_fields(params)
        applied = jnp.zeros((self.num_worlds, self.scene.model.nbody, 6), jnp.float32)
        if wrench is not None:
            applied = applied.at[:, self.scene.addresses.object_body].set(wrench)
        before = state.qpos, state.qvel, state.warmstart, ctrl, applied
        given = *before, *(fields[name] for name in _FIELDS)
        found = dict(zip((*_LAST, *_EACH), self._tick(*given), strict=True))
        qvel = found["qvel"]  # [substep, w, nv], as all of each step
        residual = inverse_dynamics_residual(
            self._rows,
            found["M"][..., self._rows.address],
            qvel - jnp.concatenate([state.qvel[None], qvel[:-1]]),
            found["qfrc_bias"],
            found["qfrc_actuator"] + found["qfrc_passive"],
            self.scene.config.physics_dt,
        )
        after = PhysicsState(found["qpos"], qvel[-1], found["qacc_warmstart"], ctrl)
        overflow = jnp.any((found["overflow"] & int(_FULL)) != 0, axis=0)
        measured = self._measured(after, found, jnp.moveaxis(residual, 0, 1))
        return after, measured, self._truth(after, found, overflow)

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

    def _measured(
        self, state: PhysicsState, found: dict[str, Array], residual: Float[Array, "w s m"]
    ) -> Measured:
        at, site, frames = self.scene.addresses, found["site_xpos"], found["site_xmat"]
        return Measured(
            q=state.qpos[:, at.robot_qpos],
            qd=state.qvel[:, at.robot_dof],
            external_torque=residual,
            palm_pos=site[:, at.palm_site],
            palm_mat=frames[:, at.palm_site],
            pad_pos=site[:, at.pad_sites],
            pad_mat=frames[:, at.pad_sites],
            joint_axis=found["xaxis"][:, self._joints],
            joint_anchor=found["xanchor"][:, self._joints],
        )

    def _truth(
        self, state: PhysicsState, found: dict[str, Array], overflow: Bool[Array, " w"]
    ) -> Truth:
        at, sensed = self.scene.addresses, found["sensordata"]
        return Truth(
            object_pos=state.qpos[:, at.object_qpos[:3]],
            object_quat=state.qpos[:, at.object_qpos[3:]],
            object_vel=state.qvel[:, at.object_dof],
            tip_found=sensed[:, at.tip_force[:, 0]] > 0,
            tip_force=sensed[:, at.tip_force[:, 1:]],
            finger_force=sensed[:, at.finger_force[:, 1:]],
            constraints=found["nefc"],
            overflow=overflow,
        )


class WarpWorlds:
    """MuJoCo Warp's arrays of all worlds on one device; on a GPU a control tick as a graph."""

    def __init__(self, scene: Scene, substeps: int, num_worlds: int, buffers: dict[str, int]):
        self._substeps, self._graph = substeps, None
        self.model = mjw.put_model(scene.model)
        # Warp would print a line per world whose line search stops early; Truth has overflows.
        self.model.opt.warn_overflow = False
        self.model.opt.tolerance.fill_(scene.model.opt.tolerance)
        self.data = mjw.make_data(scene.model, nworld=num_worlds, **buffers)
        for name in _FIELDS:  # until now one row for all worlds
            one = getattr(self.model, name)
            setattr(self.model, name, wp.zeros((num_worlds, *one.shape[1:]), one.dtype))
        arrays = {name: getattr(self.data, name) for name in _EACH}
        self._each = {n: wp.zeros((substeps, *a.shape), a.dtype) for n, a in arrays.items()}

    def captured(self) -> WarpWorlds:
        """These, with the tick as a graph where the device is a GPU."""
        if self.data.qpos.device.is_cuda:
            self._steps()  # loads the kernels
            with wp.ScopedCapture() as capture:
                self._steps()
            self._graph = capture.graph
        return self

    @property
    def given(self) -> list[wp.array]:
        """What a tick takes in: `_STATE` and `_FIELDS`."""
        state = [getattr(self.data, name) for name in _STATE]
        return state + [getattr(self.model, name) for name in _FIELDS]

    @property
    def found(self) -> list[wp.array]:
        """What comes of it: `_LAST` and `_EACH`."""
        return [getattr(self.data, name) for name in _LAST] + list(self._each.values())

    def tick(self, *arrays: wp.array) -> None:
        """Takes in, steps, and gives."""
        given, found = self.given, self.found
        for own, new in zip(given, arrays[: len(given)], strict=True):
            wp.copy(own, new)
        if self._graph is None:
            self._steps()
        else:
            wp.capture_launch(self._graph)
        for out, own in zip(arrays[len(given) :], found, strict=True):
            wp.copy(out, own)

    def _steps(self) -> None:
        for step in range(self._substeps):
            self.data.overflow.zero_()  # Warp only ever adds to it
            mjw.step(self.model, self.data)
            for name, kept in self._each.items():
                wp.copy(kept[step], getattr(self.data, name))


def _function(physics: MjxPhysics, worlds: int) -> Callable[..., tuple[Array, ...]]:
    """A control tick as a function of JAX, from `_STATE` and `_FIELDS` to `_LAST` and `_EACH`.

    Under `jax.vmap` it is one call for the worlds of all copies.
    """
    calls = _calls(physics, worlds)

    @jax.custom_batching.custom_vmap
    def tick(*given: Array) -> tuple[Array, ...]:
        return tuple(calls(*given))

    many: dict[int, Callable[..., tuple[Array, ...]]] = {}

    @tick.def_vmap
    def _(copies: int, batched: Any, *given: Array) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
        if copies not in many:
            many[copies] = _function(physics, copies * worlds)
        whole = (
            x if is_batched else jnp.broadcast_to(x, (copies, *x.shape))
            for x, is_batched in zip(given, batched, strict=True)
        )
        found = many[copies](*(x.reshape(-1, *x.shape[2:]) for x in whole))
        last = [x.reshape(copies, worlds, *x.shape[1:]) for x in found[: len(_LAST)]]
        each = [x.reshape(-1, copies, worlds, *x.shape[2:]) for x in found[len(_LAST) :]]
        return (*last, *(jnp.moveaxis(x, 1, 0) for x in each)), (True,) * len(found)

    return tick


def _calls(physics: MjxPhysics, worlds: int) -> Callable[..., list[Array]]:
    """The call of Warp for so many worlds.

    Each device that calls it has arrays of its own. Warp lets in one call at a time, so devices
    of JAX that are one to Warp, as those of a CPU are, may share them.
    """
    scene, substeps, on = physics.scene, physics.substeps, physics.on
    copies = worlds // physics.num_worlds
    buffers = physics.buffers | {"naconmax": copies * physics.buffers["naconmax"]}

    def tick(*arrays: wp.array) -> None:
        at = str(arrays[0].device), worlds
        if at not in on:
            on[at] = WarpWorlds(scene, substeps, worlds, buffers).captured()
        on[at].tick(*arrays)

    # Warp takes the arguments' types from the signature.
    with wp.ScopedDevice("cpu"):
        like = WarpWorlds(scene, substeps, 1, {"naconmax": 1, "njmax": 1})
    found = {f"found_{k}": array for k, array in enumerate(like.found)}
    arguments = {f"given_{k}": array for k, array in enumerate(like.given)} | found
    types: dict[str, Any] = {
        name: wp.array(dtype=a.dtype, ndim=a.ndim) for name, a in arguments.items()
    }
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter(name, kind, annotation=type_) for name, type_ in types.items()]
    tick.__annotations__ = types
    vars(tick)["__signature__"] = inspect.Signature(parameters)
    last = len(_LAST)
    shapes = [(worlds, *array.shape[1:]) for array in like.found[:last]]
    shapes += [(substeps, worlds, *array.shape[2:]) for array in like.found[last:]]
    return wp.jax_callable(
        tick,
        num_outputs=len(found),
        graph_mode=wp.JaxCallableGraphMode.NONE,
        output_dims=dict(zip(found, shapes, strict=True)),
    )


def _buffers(num_worlds: int, contacts: int, constraints: int) -> dict[str, int]:
    return {"naconmax": contacts * num_worlds, "njmax": constraints}


def warp_bytes_per_world(scene: Scene) -> int:
    """What MuJoCo Warp keeps of a world [bytes]."""

    def size(worlds: int) -> int:
        held = WarpWorlds(scene, 1, worlds, _buffers(worlds, _CONTACTS, _CONSTRAINTS))
        return _bytes(held.data) + sum(array.capacity for array in held.given + held.found)

    with wp.ScopedDevice("cpu"):
        return size(2) - size(1)


def _bytes(part: Any) -> int:
    """Of the arrays within a record of Warp."""
    if isinstance(part, wp.array):
        return part.capacity
    if not dataclasses.is_dataclass(part):
        return 0
    return sum(_bytes(getattr(part, field.name)) for field in dataclasses.fields(part))
