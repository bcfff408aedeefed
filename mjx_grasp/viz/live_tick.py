"""One tick of controller, physics and judge of a single world, compiled once for all objects."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Ways
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import PhysicsState, Truth, WorldParams
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import Progress, in_palm, initial_progress, slipped, update_progress

HELD = "lifted and held"
"""The outcome that is wanted."""
_REASONS = {
    Failure.NO_CANDIDATE: "no grasp is within reach",
    Failure.NOT_REACHED: "not reached in time",
    Failure.NO_CONTACT: "too few fingers found contact",
    Failure.DROPPED: "the object was lost",
    Failure.TIME_OUT: "out of time",
}


class LiveTick(NamedTuple):
    """What a tick came to; world frame."""

    phase: Int[Array | np.ndarray, ""]
    """a `Phase`"""
    failure: Int[Array | np.ndarray, ""]
    """a `Failure`"""
    clock: Float[Array | np.ndarray, ""]
    """since the start [s]"""
    entered: Float[Array | np.ndarray, " phases"]
    """clock at which each phase was last entered, NaN if it never was [s]"""
    qpos: Float[Array | np.ndarray, " nq"]
    """as the scene's model has it"""
    speed: Float[Array | np.ndarray, ""]
    """of the object [m/s]"""
    tip_error: Float[Array | np.ndarray, " 3"]
    """see `GraspTick.tip_error` [m]"""
    contacts: Float[Array | np.ndarray, "3 3"]
    """the three points that the hand goes for [m]"""
    touching: Bool[Array | np.ndarray, " f"]
    """by the simulator"""
    force: Float[Array | np.ndarray, " f"]
    """on each finger, by the simulator [N]"""
    rise: Float[Array | np.ndarray, ""]
    """of the object origin since the start [m]"""
    success: Bool[Array | np.ndarray, ""]
    """whether the object has been held up long enough"""
    plans_due: Bool[Array | np.ndarray, ""]
    """whether new plans are to be looked for"""

    @property
    def outcome(self) -> str | None:
        """How the grasp stands in words; None while that is open."""
        if self.phase == Phase.FAILED:
            return _REASONS[Failure(int(self.failure))]
        if self.phase != Phase.HOLDING:
            return None
        if not self.success:
            return "not yet held steadily"
        return HELD if self.rise >= SuccessConfig().height else "sinking"


class LiveState(NamedTuple):
    """All that goes from tick to tick; of one world, only the physics has it in front."""

    physics: PhysicsState
    measured: Measured
    truth: Truth
    grasp: GraspState
    reference: Float[Array, " 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress


def seen(truth: Truth) -> Seen:
    """What the controller is told beside its own measurements."""
    R_wo = so3.quat_to_mat(truth.object_quat)
    return Seen(truth.object_pos, R_wo, truth.tip_found, jnp.zeros((0, 4)))


@partial(jax.jit, static_argnames="grasper")
def begin(
    grasper: Grasper,
    physics: PhysicsState,
    measured: Measured,
    truth: Truth,
    known: Known,
    ways: Ways | None,
) -> LiveState:
    """The state before the first tick.

    Args:
        grasper: The controller.
        physics: Of one world, at rest.
        measured: Of it, without a batch dimension.
        truth: As well.
        known: The object.
        ways: From `Grasper.plan`.
    """
    grasp = grasper.start(measured, known, seen(truth), ways)
    here = in_palm(measured, truth)
    return LiveState(physics, measured, truth, grasp, here, initial_progress(()))


@partial(jax.jit, static_argnames="grasper")
def adopt(grasper: Grasper, state: LiveState, ways: Ways) -> LiveState:
    """Goes on with new plans."""
    return state._replace(grasp=grasper.adopt(state.grasp, ways))


@partial(jax.jit, static_argnames=("grasper", "physics"))
def advance(
    grasper: Grasper,
    physics: NativePhysics,
    state: LiveState,
    params: WorldParams,
    known: Known,
    push: Float[Array, " 3"],
    base: Float[Array, ""],
) -> tuple[LiveState, LiveTick]:
    """One control period.

    Args:
        grasper: The controller.
        physics: Of the scene.
        state: From `begin` or the last tick.
        params: Of the one world.
        known: The object.
        push: Force on the object at its centre of mass, world frame [N].
        base: Height of its origin at the start [m].
    """
    order = np.argsort(physics.scene.addresses.robot_ctrl)
    before = state.grasp.closing.closer.lifting
    grasp, done = grasper.tick(state.grasp, state.measured, known, seen(state.truth))
    wrench = jnp.concatenate([push, jnp.zeros(3)])[None]
    after, *readings = physics.step(state.physics, params, done.target[None, order], wrench)
    measured, truth = jax.tree.map(lambda leaf: leaf[0], readings)
    here = in_palm(measured, truth)
    lifting = grasp.closing.closer.lifting
    reference, slip = slipped(state.reference, before, lifting, here)
    rise = truth.object_pos[2] - base
    progress = update_progress(state.progress, rise, slip, lifting, SuccessConfig(), grasper.dt)
    tick = LiveTick(
        phase=grasp.phase,
        failure=grasp.failure,
        clock=grasp.clock,
        entered=grasp.entered,
        qpos=after.qpos[0],
        speed=jnp.linalg.norm(truth.object_vel[:3]),
        tip_error=done.tip_error,
        contacts=done.contacts.position,
        touching=truth.tip_found,
        force=jnp.linalg.norm(truth.finger_force, axis=-1),
        rise=rise,
        success=progress.success,
        plans_due=done.plans_due,
    )
    return LiveState(after, measured, truth, grasp, reference, progress), tick
