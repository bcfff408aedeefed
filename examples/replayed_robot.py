"""A grasp's log, and a robot that replays it: controllers and drivers without anything that moves.

    python examples/replayed_robot.py [LOG.npz]

Without a log there, a grasp in simulation is logged. Then it is replayed to a controller that
begins anew, which commands what was commanded then. The log of a real robot shows in the same way
whether a driver supplies what the controller asks for, and what another version of the controller
would have done.
"""

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import mjx_grasp
from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError
from mjx_grasp.geometry import so3
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.pipeline.state import Tried
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.interface import measured_from_joints, measuring_kinematics

READ = ("q", "qd", "external_torque")
"""What a driver reads; the rest of `Measured` follows."""
SEEN = ("p_wo", "R_wo", "touching")
"""What is perceived beside it, without anything in the way."""


@dataclass
class Log:
    """What was read, seen and commanded; an entry for each control period."""

    read: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    seen: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    target: list[np.ndarray] = field(default_factory=list)

    def add(self, measured: mjx_grasp.Measured, seen: mjx_grasp.Seen, target: np.ndarray) -> None:
        """Adds a control period."""
        self.read.append(tuple(np.asarray(getattr(measured, name)) for name in READ))
        self.seen.append(tuple(np.asarray(getattr(seen, name)) for name in SEEN))
        self.target.append(np.asarray(target))

    def save(self, path: Path) -> None:
        """Writes it."""
        columns = *zip(*self.read, strict=True), *zip(*self.seen, strict=True), self.target
        names = *READ, *SEEN, "target"
        np.savez_compressed(path, **dict(zip(names, map(np.stack, columns), strict=True)))

    @classmethod
    def load(cls, path: Path) -> "Log":
        """Reads it.

        Raises:
            FileError: It is no log.
        """
        try:
            with np.load(path) as kept:
                read = list(zip(*(kept[name] for name in READ), strict=True))
                seen = list(zip(*(kept[name] for name in SEEN), strict=True))
                return cls(read, seen, list(kept["target"]))
        except Exception as error:  # NumPy's reader raises whatever it meets
            raise FileError(path, f"no log ({error})", "a .npz that this example wrote") from None


class JointsOfSim(mjx_grasp.SimRobot):
    """A simulated robot of which only joints are read, as of a real one."""

    def read(self) -> mjx_grasp.Measured:
        """See `Robot.read`."""
        measured = super().read()
        return of_joints(self.spec)(*(getattr(measured, name) for name in READ))


@functools.cache
def of_joints(spec: RobotSpec) -> Callable[..., mjx_grasp.Measured]:
    """What is measured, from what a driver reads."""
    kinematics = measuring_kinematics(spec)
    return jax.jit(lambda *read: measured_from_joints(kinematics, *read))


class ReplayedRobot:
    """A robot that measures what is in a log, whatever it is sent; a `Robot`.

    Args:
        log: The log.
        spec: The robot that it is of.
        control_dt: Its control period [s].
    """

    def __init__(self, log: Log, spec: RobotSpec, control_dt: float = 0.01):
        self.spec, self.control_dt, self._log = spec, control_dt, log
        self.sent: list[np.ndarray] = []
        self.is_connected = False

    def connect(self) -> None:
        """See `Robot.connect`; the log is at its first period."""
        self.is_connected, self.sent = True, []

    def disconnect(self) -> None:
        """See `Robot.disconnect`."""
        self.is_connected = False

    def read(self) -> mjx_grasp.Measured:
        """See `Robot.read`."""
        return of_joints(self.spec)(*map(jnp.asarray, self._log.read[len(self.sent)]))

    def look(self) -> mjx_grasp.Seen:
        """What was perceived beside the robot."""
        now = map(jnp.asarray, self._log.seen[len(self.sent)])
        return mjx_grasp.Seen(*now, jnp.zeros((0, 4)))

    def command(self, target: np.ndarray) -> None:
        """See `Robot.command`; keeps it, and goes on to the next period."""
        self.sent.append(np.asarray(target))


def grasp(robot, look, grasper, library, known, periods):
    """So many control periods of a grasp; where plans are due, it waits for them."""
    plan = jax.jit(lambda *given: grasper.plan(library, *given))
    start, tick, adopt = map(jax.jit, (grasper.start, grasper.tick, grasper.adopt))
    key, log = jax.random.key(0), Log()
    measured, seen = robot.read(), look()
    ways = plan(known, seen, measured.q, key, Tried.nothing())
    state = start(measured, known, seen, ways)
    for _ in range(periods):
        measured, seen = robot.read(), look()
        state, done = tick(state, measured, known, seen)
        log.add(measured, seen, done.target)
        robot.command(done.target)
        if done.plans_due:
            state = adopt(state, plan(known, seen, measured.q, key, state.tried))
    return Phase(int(state.phase)), log


def main(path: Path | None = None, periods: int = 350) -> tuple[Phase, float]:
    """Logs a grasp in simulation, unless there is a log, and replays it.

    Args:
        path: The log; None keeps none.
        periods: How long a grasp is logged [control periods].

    Returns:
        How the replayed grasp ended, and how far what is commanded now is from what was then [rad].

    Raises:
        FileError: The log's name is another file's, or it holds something else.
    """
    if path is not None and path.suffix != ".npz":
        raise FileError(path, "no name of a log", "one that ends in .npz")
    spec, cube = mjx_grasp.load_robot(), mjx_grasp.load_object("rubiks_cube")
    grasper = mjx_grasp.grasper_of(spec)
    library = mjx_grasp.start_library(grasper.reacher.body, grasper.planner.config)
    given = grasper, library, mjx_grasp.known_object(cube, spec)
    if path is None or not path.exists():
        scene = mjx_grasp.build_scene([cube], spec)
        qpos = scene.model.qpos0.copy()
        qpos[scene.addresses.robot_qpos] = spec.home
        qpos[scene.addresses.object_qpos] = [0.5, -0.1, -cube.mesh.bounds[0, 2], 1, 0, 0, 0]
        robot = JointsOfSim(scene, qpos, cube.name)

        def look() -> mjx_grasp.Seen:
            truth = robot.truth()
            pose = truth.object_pos, so3.quat_to_mat(truth.object_quat)
            return mjx_grasp.Seen(*pose, truth.tip_found, jnp.zeros((0, 4)))

        robot.connect()
        phase, log = grasp(robot, look, *given, periods)
        print(f"logged {periods} periods; {phase.name.lower()}")
        if path is not None:
            log.save(path)
    else:
        log = Log.load(path)
    replayed = ReplayedRobot(log, spec)
    replayed.connect()
    phase, _ = grasp(replayed, replayed.look, *given, len(log.target))
    apart = float(np.abs(np.stack(replayed.sent) - np.stack(log.target)).max())
    print(f"replayed; {phase.name.lower()}, commands at most {apart:.1e} rad from those of then")
    return phase, apart


if __name__ == "__main__":
    run_command(lambda: main(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
