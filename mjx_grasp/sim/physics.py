"""The small interface between physics and everything else: one control tick in, two records out.

Both engines step all worlds by one control tick and fill the same `Measured`, which a robot has
too, and `Truth`, which only a simulator has. What observes, rewards or controls is pure JAX over
them and does not know which engine filled them.

Frames, axes and contacts belong to the state before the last physics step of the tick, as MuJoCo
leaves them; joints and the object's pose are those after it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.robot.indices import robot_indices
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.scene import Scene


class PhysicsState(NamedTuple):
    """Everything that determines the future of the worlds."""

    qpos: Float[Array, "w nq"]
    qvel: Float[Array, "w nv"]
    warmstart: Float[Array, "w nv"]
    """acceleration at which the solver begins, that of the step before"""
    ctrl: Float[Array, "w nu"]
    """position commands [rad]"""


class WorldParams(NamedTuple):
    """What differs between worlds besides their state."""

    object_index: Int[Array, " w"]
    """Which object of the scene the world holds."""
    friction: Float[Array, " w"]
    """Sliding friction of the object's contacts [-]."""
    mass_scale: Float[Array, " w"]
    """Factor on the object's mass and inertia [-]."""


class Truth(NamedTuple):
    """What only a simulator knows. World frame, SI units; fingers in the order of the hand's."""

    object_pos: Float[Array, "*w 3"]
    """object origin [m]"""
    object_quat: Float[Array, "*w 4"]
    object_vel: Float[Array, "*w 6"]
    """linear velocity [m/s] in the world, angular [rad/s] in the object frame, as MuJoCo has it"""
    tip_found: Bool[Array, "*w f"]
    """whether the fingertip touches the object"""
    tip_force: Float[Array, "*w f 3"]
    """net contact force of the object on the fingertip or its reaction: use its norm [N]"""
    finger_force: Float[Array, "*w f 3"]
    """the same for the whole finger [N]"""
    constraints: Int[Array, "*w"]
    """constraint rows in use after the last physics step"""
    overflow: Bool[Array, "*w"]
    """whether a contact or constraint buffer overflowed during the tick"""


class Physics(ABC):
    """Steps worlds of one scene. All methods are pure and may be called inside `jax.jit`.

    Args:
        scene: The scene whose objects the worlds hold.
        control_dt: Control period [s].
    """

    def __init__(self, scene: Scene, control_dt: float):
        self.scene = scene
        self.substeps = check_control_rate(scene, control_dt)

    def init(self, qpos: Float[Array, "w nq"], ctrl: Float[Array, "w nu"]) -> PhysicsState:
        """A state at rest.

        Args:
            qpos: Where everything is.
            ctrl: Position commands [rad].
        """
        zeros = jnp.zeros((len(qpos), self.scene.model.nv), jnp.float32)
        qpos, ctrl = jnp.asarray(qpos, jnp.float32), jnp.asarray(ctrl, jnp.float32)
        return PhysicsState(qpos, zeros, zeros, ctrl)

    def reset(
        self,
        state: PhysicsState,
        mask: Bool[Array, " w"],
        qpos: Float[Array, "w nq"],
        ctrl: Float[Array, "w nu"],
    ) -> PhysicsState:
        """Puts the masked worlds at rest at `qpos`; the others are untouched."""
        fresh = self.init(qpos, ctrl)
        return jax.tree.map(lambda new, old: jnp.where(mask[:, None], new, old), fresh, state)

    @abstractmethod
    def step(
        self,
        state: PhysicsState,
        params: WorldParams,
        ctrl: Float[Array, "w nu"],
        wrench: Float[Array, "w 6"] | None = None,
        awake: Bool[Array, " w"] | None = None,
    ) -> tuple[PhysicsState, Measured, Truth]:
        """One control tick.

        Args:
            state: Before.
            params: Of the worlds.
            ctrl: Position commands [rad].
            wrench: On the object at its centre of mass during the tick, world frame: force [N],
                torque [N m].
            awake: Worlds that go on, all by default; what is given of the others is void.
        """


class FingerRows(NamedTuple):
    """The grasping fingers' rows of the symmetric mass matrix, as gathers from MuJoCo's M.

    M holds the lower triangle; a row of the whole matrix takes its own entries and those of its
    descendants' rows. Rows are padded with entries of weight 0.
    """

    dof: np.ndarray  # [m]
    address: np.ndarray  # [m, k] into M
    column: np.ndarray  # [m, k] dof
    weight: np.ndarray  # [m, k] 1 or 0
    damping: np.ndarray  # [m] joint damping + actuator velocity gain [N m s/rad]


def finger_dofs(scene: Scene) -> np.ndarray:
    """Degrees of freedom of the three fingers' joints, finger by finger, [m]."""
    return scene.addresses.robot_dof[robot_indices(scene.robot).grasping]


def finger_rows(scene: Scene) -> FingerRows:
    """Builds the gathers of `inverse_dynamics_residual` from the compiled model."""
    m = scene.model
    dofs = finger_dofs(scene)
    rows: dict[int, list[tuple[int, int]]] = {int(d): [] for d in dofs}
    for i in range(m.nv):
        start = m.M_rowadr[i]
        for k in range(m.M_rownnz[i]):
            j = int(m.M_colind[start + k])
            if i in rows:
                rows[i].append((start + k, j))
            if j in rows and j != i:
                rows[j].append((start + k, i))
    width = max(len(r) for r in rows.values())
    address = np.zeros((len(dofs), width), np.int32)
    column = np.zeros((len(dofs), width), np.int32)
    weight = np.zeros((len(dofs), width), np.float32)
    damping = np.zeros(len(dofs), np.float32)
    for r, d in enumerate(dofs):
        for k, (adr, col) in enumerate(rows[int(d)]):
            address[r, k], column[r, k], weight[r, k] = adr, col, 1.0
        actuator = next(a for a in range(m.nu) if m.actuator_trnid[a, 0] == m.dof_jntid[d])
        damping[r] = m.dof_damping[d] - m.actuator_biasprm[actuator, 2]
    return FingerRows(dofs, address, column, weight, damping)


def inverse_dynamics_residual(
    rows: FingerRows,
    mass: Float[Array, "*w m k"],
    delta_v: Float[Array, "*w nv"],
    bias: Float[Array, "*w nv"],
    applied: Float[Array, "*w nv"],
    dt: float,
) -> Float[Array, "*w m"]:
    """Torque on the fingers' joints that the model does not explain: contacts, stops, dry friction.

    M Δv/dt + c − τ [N m], the forcing of the momentum observer (method §5), with τ taken at the
    end of the step: MuJoCo's implicit integrator applies damping at the new velocity.

    Args:
        rows: From `finger_rows`.
        mass: MuJoCo's M at `rows.address`, at the start of the physics step.
        delta_v: Change of velocity over the step [rad/s].
        bias: qfrc_bias at the start of the step.
        applied: qfrc_actuator + qfrc_passive at the start of the step.
        dt: Physics step [s].
    """
    inertial = jnp.sum(mass * rows.weight * delta_v[..., rows.column], axis=-1)
    own = delta_v[..., rows.dof]
    return inertial / dt + bias[..., rows.dof] - applied[..., rows.dof] + rows.damping * own


def make_params(
    object_index: Int[Array, " w"], friction: float | jax.Array, mass_scale: float | jax.Array = 1.0
) -> WorldParams:
    """World parameters with scalars broadcast over the worlds."""
    index = jnp.asarray(object_index, jnp.int32)
    return WorldParams(
        index,
        jnp.broadcast_to(jnp.asarray(friction, jnp.float32), index.shape),
        jnp.broadcast_to(jnp.asarray(mass_scale, jnp.float32), index.shape),
    )


def check_control_rate(scene: Scene, control_dt: float) -> int:
    """Physics steps per control tick.

    Raises:
        InputError: The control period is no whole number of physics steps.
    """
    ratio = control_dt / scene.config.physics_dt
    if ratio < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise InputError(
            "control_dt", control_dt, f"a whole multiple of physics_dt {scene.config.physics_dt}"
        )
    return round(ratio)
