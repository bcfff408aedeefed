"""One whole grasp at a time in native MuJoCo, tick by tick, for somebody to watch and disturb.

`LiveGrasp` owns the physics and the controller's state; what shows it calls `put`, `start` and
`tick`. New plans are looked for beside the loop, as a robot would.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.plans import Wanted, planned
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import Known, Tried, Ways
from mjx_grasp.posture.library import Library
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.native import NativePhysics, at_rest
from mjx_grasp.sim.physics import Truth, WorldParams, make_params
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.live_tick import LiveState, LiveTick, adopt, advance, begin, seen

HOLD_S = 30.0
"""Time at the top after which a grasp is over [s]."""
_FALL_S = 1.0
"""Time for which a grasp that failed is still simulated: what falls is seen to fall [s]."""
_STILL = 0.02
"""Speed below which an object that no finger touches is taken to lie where it is [m/s]."""
_NO_PUSH = np.zeros(3)
_SOMEWHERE = np.array([0.5, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])


class LiveGrasp:
    """A robot at a table with one of several objects.

    Not for several threads, apart from `prepare`.

    Args:
        grasper: The controller.
        physics: Of a scene with all objects, in one thread.
    """

    def __init__(self, grasper: Grasper, physics: NativePhysics):
        self.grasper, self.scene = grasper, physics.scene
        self._physics, self._key = physics, jax.random.key(0)
        self._home = np.asarray(grasper.reacher.body.home, np.float32)
        self._library: Library | None = None
        self._beside = ThreadPoolExecutor(1)
        self._plans: Future[Ways | None] | None = None
        self._state: LiveState | None = None
        self._running = False
        self.last: LiveTick | None = None
        """of the tick before; None before the first"""
        self.put(0, *_SOMEWHERE)

    @property
    def qpos(self) -> Float[np.ndarray, " nq"]:
        """Where everything is, as the scene's model has it."""
        return self._qpos if self.last is None else np.asarray(self.last.qpos)

    @property
    def object_pose(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Of the object's frame in the world: origin [m] and quaternion w-x-y-z."""
        pose = self.qpos[self.scene.addresses.object_qpos]
        return pose[:3], pose[3:]

    @property
    def done(self) -> bool:
        """Whether no grasp runs: none has begun, or it has failed or held for `HOLD_S`."""
        if not self._running or self.last is None:
            return not self._running
        phase = Phase(int(self.last.phase))
        limit = {Phase.FAILED: _FALL_S, Phase.HOLDING: HOLD_S}.get(phase, np.inf)
        return bool(self.last.clock - self.last.entered[phase] >= limit)

    def with_more(self, obj: ObjectModel) -> LiveGrasp:
        """The same robot at a table with one object more; `prepare` has less to do for it.

        Raises:
            InputError: There is an object of this name.
        """
        names = self.scene.object_names
        if obj.name in names:
            raise InputError("object", obj.name, f"a name that is not there ({', '.join(names)})")
        scene = build_scene([*self.scene.objects, obj], self.scene.robot, self.scene.config)
        made = LiveGrasp(self.grasper, NativePhysics(scene, self.grasper.dt, threads=1))
        made._library, made._key = self._library, self._key
        return made

    def prepare(self, known: Known, tell: Callable[[str], None] = lambda text: None) -> None:
        """Draws the planner's library and compiles everything; changes no state of the grasp.

        Args:
            known: Any object of the scene.
            tell: Told what is being worked on.
        """
        planner, library = self.grasper.planner, self._library
        if planner is not None and library is None:
            tell("drawing postures to start from")
            library = start_library(self.grasper.reacher.body, planner.config)
        qpos = self._begin(*_SOMEWHERE)
        tell("compiling the planner")
        state = self._started(known, qpos, library, jax.random.key(0))
        tell("compiling the controller")
        params, base = self._params(0), jnp.float32(0.0)
        advance(self.grasper, self._physics, state, params, known, jnp.zeros(3), base)
        if state.grasp.ways is not None:
            adopt(self.grasper, state, state.grasp.ways)
        self._library = library

    def put(self, index: int, p_wo: Float[np.ndarray, " 3"], quat: Float[np.ndarray, " 4"]) -> None:
        """Puts the robot home and an object at rest where it is wanted; ends what runs.

        Args:
            index: Of the object in the scene.
            p_wo: Its origin in the world [m].
            quat: Its rotation, w-x-y-z.
        """
        self.stop()
        self._index, self._qpos = index, self._begin(p_wo, quat)
        self._state = self.last = None
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
        self._state = self._started(known, self._qpos, self._library, key)
        self._running = True

    def tick(self, push: Float[np.ndarray, " 3"] = _NO_PUSH) -> LiveTick:
        """One control period.

        Args:
            push: Force on the object at its centre of mass, world frame [N].
        """
        assert self._state is not None, "start() first"
        force, params = jnp.asarray(push, jnp.float32), self._params(self._index)
        self._state, tick = advance(
            self.grasper, self._physics, self._state, params, self._known, force, self._base
        )
        self.last = jax.device_get(tick)
        self._replan(bool(tick.plans_due))
        return self.last

    def close(self) -> None:
        """Ends the thread that plans."""
        self.stop()
        self._beside.shutdown(wait=False, cancel_futures=True)

    def _begin(
        self, p_wo: Float[np.ndarray, " 3"], quat: Float[np.ndarray, " 4"]
    ) -> Float[np.ndarray, " nq"]:
        qpos = np.zeros(self.scene.model.nq, np.float32)
        qpos[self.scene.addresses.robot_qpos] = self._home
        qpos[self.scene.addresses.object_qpos] = np.concatenate([p_wo, quat])
        return qpos

    def _lies(self) -> bool:
        """Whether the object has come to rest on the table, by itself."""
        if self.last is None:
            return True
        alone = self.last.speed < _STILL and not self.last.force.any()
        return bool(alone and self.object_pose[0][2] > 0.0)

    def _params(self, index: int) -> WorldParams:
        return make_params(jnp.array([index]), self.scene.config.friction[0])

    def _started(
        self, known: Known, qpos: Float[np.ndarray, " nq"], library: Library | None, key: Array
    ) -> LiveState:
        at = self.scene.addresses
        measured, truth = at_rest(self.scene, qpos[None], self._physics.substeps)
        ctrl = jnp.asarray(self._home[np.argsort(at.robot_ctrl)])[None]
        measured, truth = jax.tree.map(lambda leaf: leaf[0], (measured, truth))
        ways = self._ways(library, known, measured, truth, Tried.nothing(), key)
        physics = self._physics.init(jnp.asarray(qpos[None]), ctrl)
        return begin(self.grasper, physics, measured, truth, known, ways)

    def _ways(
        self,
        library: Library | None,
        known: Known,
        measured: Measured,
        truth: Truth,
        tried: Tried,
        key: Array,
    ) -> Ways | None:
        if library is None:
            return None
        wanted = Wanted(known, seen(truth), measured.q, tried, key)
        many = jax.tree.map(lambda leaf: leaf[None], wanted)
        found = planned(self.grasper, library, many, np.arange(1))
        return jax.block_until_ready(jax.tree.map(lambda leaf: leaf[0], found))

    def _replan(self, due: bool) -> None:
        """Takes plans over that are ready, and has new ones looked for where they are due."""
        assert self._state is not None
        if self._plans is not None and self._plans.done():
            ways, self._plans = self._plans.result(), None
            if ways is not None:
                self._state = adopt(self.grasper, self._state, ways)
        elif self._plans is None and due:
            state, (self._key, key) = self._state, jax.random.split(self._key)
            now = state.measured, state.truth, state.grasp.tried
            self._plans = self._beside.submit(self._ways, self._library, self._known, *now, key)
