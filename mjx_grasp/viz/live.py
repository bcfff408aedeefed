"""One whole grasp at a time in native MuJoCo, tick by tick, for somebody to watch and disturb.

`LiveGrasp` owns the physics and the controller's state; what shows it calls `put`, `start` and
`tick`. New plans are looked for beside the loop, as a robot would.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.evaluation.grasps.plans import planned
from mjx_grasp.geometry import so3
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.pipeline.state import GraspState, Known, Seen, Ways
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import NativePhysics, NativeState, at_rest
from mjx_grasp.sim.physics import Truth, WorldParams, make_params
from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import Progress, in_palm, initial_progress, update_progress

HOLD_S = 30.0
"""Time at the top after which a grasp is over [s]."""
_FALL_S = 1.0
"""Time for which a grasp that failed is still simulated: what falls is seen to fall [s]."""
_STILL = 0.02
"""Speed below which an object that no finger touches is taken to lie where it is [m/s]."""
_NO_PUSH = np.zeros(3)
_SOMEWHERE = np.array([0.5, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])
_REASONS = {
    Failure.NO_CANDIDATE: "no grasp is within reach",
    Failure.NOT_REACHED: "not reached in time",
    Failure.NO_CONTACT: "too few fingers found contact",
    Failure.DROPPED: "the object was lost",
    Failure.TIME_OUT: "out of time",
}


class LiveTick(NamedTuple):
    """What a tick came to; arrays are NumPy's, without a batch dimension, world frame."""

    phase: Phase
    failure: Failure
    clock: float
    """since the start [s]"""
    qpos: Float[np.ndarray, " nq"]
    """as the scene's model has it"""
    tip_error: Float[np.ndarray, " 3"]
    """see `GraspTick.tip_error` [m]"""
    contacts: Float[np.ndarray, "3 3"]
    """the three points that the hand goes for [m]"""
    touching: Bool[np.ndarray, " f"]
    """by the simulator"""
    force: Float[np.ndarray, " f"]
    """on each finger, by the simulator [N]"""
    rise: float
    """of the object origin since the start [m]"""
    success: bool
    """whether the object has been held up long enough"""

    @property
    def outcome(self) -> str | None:
        """How the grasp stands in words; None while that is open."""
        if self.phase == Phase.FAILED:
            return _REASONS[self.failure]
        if self.phase == Phase.HOLDING and self.success:
            return "lifted and held" if self.rise >= SuccessConfig().height else "sinking"
        return None


class _Carry(NamedTuple):
    """All that goes from tick to tick; of one world, only the physics has it in front."""

    physics: NativeState
    measured: Measured
    truth: Truth
    grasp: GraspState
    reference: Float[Array, " 3"]
    """object origin in the palm frame, followed until lift onset and then kept [m]"""
    progress: Progress


class LiveGrasp:
    """A robot at a table with one of several objects.

    Not for several threads, apart from `prepare`.

    Args:
        grasper: The controller.
        physics: Of a scene with all objects, in one thread.
        seed: Of what plans try at random.
    """

    def __init__(self, grasper: Grasper, physics: NativePhysics, seed: int = 0):
        self.grasper, self.scene = grasper, physics.scene
        self._physics, self._key = physics, jax.random.key(seed)
        self._home = np.asarray(grasper.reacher.body.home, np.float32)
        self._library: Library | None = None
        self._beside = ThreadPoolExecutor(1)
        self._plans: Future[Ways | None] | None = None
        self._carry: _Carry | None = None
        self._running = False
        self.last: LiveTick | None = None
        """of the tick before; None before the first"""
        self.put(0, *_SOMEWHERE)

    @property
    def qpos(self) -> Float[np.ndarray, " nq"]:
        """Where everything is, as the scene's model has it."""
        return self._qpos if self.last is None else self.last.qpos

    @property
    def object_pose(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Of the object's frame in the world: origin [m] and quaternion w-x-y-z."""
        pose = self.qpos[self.scene.addresses.object_qpos]
        return pose[:3], pose[3:]

    @property
    def done(self) -> bool:
        """Whether no grasp runs: none has begun, or it has failed or held for `HOLD_S`."""
        if not self._running or self._carry is None or self.last is None:
            return not self._running
        limit = {Phase.FAILED: _FALL_S, Phase.HOLDING: HOLD_S}.get(self.last.phase, np.inf)
        entered = float(self._carry.grasp.entered[self.last.phase])
        return self.last.clock - entered >= limit

    def prepare(self, known: Known, tell: Callable[[str], None] = lambda text: None) -> None:
        """Draws the planner's library and compiles everything; changes no state of the grasp.

        Args:
            known: Any object of the scene.
            tell: Told what is being worked on.
        """
        planner, library = self.grasper.planner, None
        if planner is not None:
            tell("drawing postures to start from")
            library = start_library(self.grasper.reacher.body, planner.config)
        qpos = self._begin(0, *_SOMEWHERE)
        tell("compiling the planner")
        carry = self._started(known, qpos, library, jax.random.key(0))
        tell("compiling the controller")
        params, base = self._params(0), jnp.float32(qpos[self.scene.addresses.object_qpos[2]])
        _tick(self.grasper, self._physics, carry, params, known, jnp.zeros(3), base)
        if carry.grasp.ways is not None:
            _adopted(self.grasper, carry.grasp, carry.grasp.ways)
        self._library = library

    def put(self, index: int, p_wo: Float[np.ndarray, " 3"], quat: Float[np.ndarray, " 4"]) -> None:
        """Puts the robot home and an object at rest where it is wanted; ends what runs.

        Args:
            index: Of the object in the scene.
            p_wo: Its origin in the world [m].
            quat: Its rotation, w-x-y-z.
        """
        self.stop()
        self._index, self._qpos = index, self._begin(index, p_wo, quat)
        self._carry = self.last = None
        self._placed = self.object_pose

    def stop(self) -> None:
        """Ends what runs; robot and object stay where they are."""
        self._plans, self._running = None, False

    def start(self, known: Known) -> None:
        """Begins a grasp from home, of the object where it lies.

        An object in the air or in the hand is put back to where it was put before. Looks for plans,
        which takes longer than a tick.

        Args:
            known: The object, its candidates with the scores that are to decide.
        """
        lies = self._lies()
        self.put(self._index, *(self.object_pose if lies else self._placed))
        self._key, key = jax.random.split(self._key)
        self._known = known
        self._base = jnp.float32(self._qpos[self.scene.addresses.object_qpos[2]])
        self._carry = self._started(known, self._qpos, self._library, key)
        self._running = True

    def tick(self, push: Float[np.ndarray, " 3"] = _NO_PUSH) -> LiveTick:
        """One control period.

        Args:
            push: Force on the object at its centre of mass, world frame [N].
        """
        assert self._carry is not None, "start() first"
        force, params = jnp.asarray(push, jnp.float32), self._params(self._index)
        self._carry, seen_of, due = _tick(
            self.grasper, self._physics, self._carry, params, self._known, force, self._base
        )
        found, due = jax.device_get((seen_of, due))
        self._replan(bool(due))
        self.last = LiveTick(
            phase=Phase(int(found.phase)),
            failure=Failure(int(found.failure)),
            clock=float(found.clock),
            qpos=found.qpos,
            tip_error=found.tip_error,
            contacts=found.contacts,
            touching=found.touching,
            force=found.force,
            rise=float(found.rise),
            success=bool(found.success),
        )
        return self.last

    def close(self) -> None:
        """Ends the thread that plans."""
        self.stop()
        self._beside.shutdown(wait=False, cancel_futures=True)

    def _begin(
        self, index: int, p_wo: Float[np.ndarray, " 3"], quat: Float[np.ndarray, " 4"]
    ) -> Float[np.ndarray, " nq"]:
        qpos = np.zeros(self.scene.model.nq, np.float32)
        qpos[self.scene.addresses.robot_qpos] = self._home
        qpos[self.scene.addresses.object_qpos] = np.concatenate([p_wo, quat])
        return qpos

    def _lies(self) -> bool:
        """Whether the object has come to rest on the table, by itself."""
        if self._carry is None or self.last is None:
            return self.last is None
        still = float(jnp.linalg.norm(self._carry.truth.object_vel[:3])) < _STILL
        return still and not self.last.force.any() and float(self.object_pose[0][2]) > 0.0

    def _params(self, index: int) -> WorldParams:
        return make_params(jnp.array([index]), self.scene.config.friction[0])

    def _started(
        self, known: Known, qpos: Float[np.ndarray, " nq"], library: Library | None, key: Array
    ) -> _Carry:
        at = self.scene.addresses
        measured, truth = at_rest(self.scene, qpos[None], self._physics.substeps)
        ctrl = jnp.asarray(self._home[np.argsort(at.robot_ctrl)])[None]
        measured, truth = jax.tree.map(lambda leaf: leaf[0], (measured, truth))
        ways = self._ways(library, known, measured, truth, jnp.full(3, jnp.inf, jnp.float32), key)
        return _Carry(
            self._physics.init(jnp.asarray(qpos[None]), ctrl),
            measured,
            truth,
            _start(self.grasper, measured, known, _seen(truth), ways),
            in_palm(measured, truth),
            initial_progress(()),
        )

    def _ways(
        self,
        library: Library | None,
        known: Known,
        measured: Measured,
        truth: Truth,
        avoid: Float[Array, " 3"],
        key: Array,
    ) -> Ways | None:
        if library is None:
            return None
        given = known, _seen(truth), measured.q, avoid
        many, seen, q, avoid = jax.tree.map(lambda leaf: leaf[None], given)
        found = planned(self.grasper, library, many, seen, q, avoid, key, np.arange(1))
        return jax.block_until_ready(jax.tree.map(lambda leaf: leaf[0], found))

    def _replan(self, due: bool) -> None:
        """Takes plans over that are ready, and has new ones looked for where they are due."""
        assert self._carry is not None
        if self._plans is not None and self._plans.done():
            ways, self._plans = self._plans.result(), None
            if ways is not None:
                grasp = _adopted(self.grasper, self._carry.grasp, ways)
                self._carry = self._carry._replace(grasp=grasp)
        elif self._plans is None and due:
            carry, (self._key, key) = self._carry, jax.random.split(self._key)
            now = carry.measured, carry.truth, carry.grasp.avoid
            self._plans = self._beside.submit(self._ways, self._library, self._known, *now, key)


class _Found(NamedTuple):
    """A `LiveTick` before it leaves the device."""

    phase: Int[Array, ""]
    failure: Int[Array, ""]
    clock: Float[Array, ""]
    qpos: Float[Array, " nq"]
    tip_error: Float[Array, " 3"]
    contacts: Float[Array, "3 3"]
    touching: Bool[Array, " f"]
    force: Float[Array, " f"]
    rise: Float[Array, ""]
    success: Bool[Array, ""]


def _seen(truth: Truth) -> Seen:
    """What the controller is told beside its own measurements."""
    R_wo = so3.quat_to_mat(truth.object_quat)
    return Seen(truth.object_pos, R_wo, truth.tip_found, jnp.zeros((0, 4)))


@partial(jax.jit, static_argnames="grasper")
def _start(
    grasper: Grasper, measured: Measured, known: Known, seen: Seen, ways: Ways | None
) -> GraspState:
    return grasper.start(measured, known, seen, ways)


@partial(jax.jit, static_argnames="grasper")
def _adopted(grasper: Grasper, state: GraspState, ways: Ways) -> GraspState:
    return grasper.adopt(state, ways)


@partial(jax.jit, static_argnames=("grasper", "physics"))
def _tick(
    grasper: Grasper,
    physics: NativePhysics,
    carry: _Carry,
    params: WorldParams,
    known: Known,
    push: Float[Array, " 3"],
    base: Float[Array, ""],
) -> tuple[_Carry, _Found, Bool[Array, ""]]:
    """A tick of controller, physics and judge; also whether new plans are due."""
    order = np.argsort(physics.scene.addresses.robot_ctrl)
    before = carry.grasp.closing.closer.lifting
    grasp, done = grasper.tick(carry.grasp, carry.measured, known, _seen(carry.truth))
    state, *after = physics.step(carry.physics, params, done.target[None, order], push[None])
    measured, truth = jax.tree.map(lambda leaf: leaf[0], after)
    here = in_palm(measured, truth)
    reference = jnp.where(before, carry.reference, here)
    slip = jnp.where(grasp.closing.closer.lifting, jnp.linalg.norm(here - reference), 0.0)
    rise = truth.object_pos[2] - base
    progress = update_progress(carry.progress, rise, slip, SuccessConfig(), grasper.dt)
    found = _Found(
        phase=grasp.phase,
        failure=grasp.failure,
        clock=grasp.clock,
        qpos=state.qpos[0],
        tip_error=done.tip_error,
        contacts=done.contacts.position,
        touching=truth.tip_found,
        force=jnp.linalg.norm(truth.finger_force, axis=-1),
        rise=rise,
        success=progress.success,
    )
    after_all = _Carry(state, measured, truth, grasp, reference, progress)
    return after_all, found, done.plans_due
