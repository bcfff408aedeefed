"""A recorded motion in one file, from which it can be rendered anywhere: model, poses, time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.archive import ArchiveKind, Arrays, Header, read_archive, write_archive
from mjx_grasp.records.settings import Positive, Settings
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity

if TYPE_CHECKING:
    import mujoco

    from mjx_grasp.sim.scene import Scene


@dataclass(frozen=True)
class Trajectory:
    """Poses of a compiled model over time."""

    model: bytes
    """The compiled model in MuJoCo's binary format (.mjb)."""
    mujoco_version: str
    """The version that wrote `model`; only the same version can read it."""
    qpos: Float[np.ndarray, "t nq"]
    dt: float
    """Time between two poses [s]."""
    focus: str
    """The body that a camera should follow."""
    robot: RobotIdentity | None = None
    """The robot that moves; None if there is none."""

    def __post_init__(self) -> None:
        if self.qpos.ndim != 2 or not self.qpos.size or not np.isfinite(self.qpos).all():
            raise InputError("Trajectory.qpos", self.qpos.shape, "finite numbers of shape [t, nq]")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError("Trajectory.dt", self.dt, "a positive time in seconds")

    @property
    def seconds(self) -> float:
        """Time from the first pose to the last [s]."""
        return self.dt * (len(self.qpos) - 1)


def record(
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, "t nq"],
    dt: float,
    focus: str = "object",
    robot: RobotIdentity | None = None,
) -> Trajectory:
    """A trajectory of a compiled model.

    Args:
        model: The model; the trajectory keeps a copy.
        qpos: One pose per time.
        dt: Time between two poses [s].
        focus: Name of the body that a camera should follow.
        robot: The robot of the model.

    Raises:
        InputError: The poses do not fit the model, or it has no such body.
    """
    import mujoco

    qpos = np.asarray(qpos, float)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq:
        raise InputError("qpos", qpos.shape, f"shape [t, {model.nq}]")
    names = [model.body(i).name for i in range(model.nbody)]
    if focus not in names:
        raise InputError("focus", focus, f"one of the bodies {', '.join(n for n in names if n)}")
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return Trajectory(buffer.tobytes(), mujoco.__version__, qpos, float(dt), focus, robot)


def record_world(
    scene: Scene, object_name: str, qpos: Float[np.ndarray, "t nq"], dt: float
) -> Trajectory:
    """A trajectory of one world of a scene: the pieces of the other objects are not shown.

    Args:
        scene: The scene, with one object or many.
        object_name: The object that the world holds.
        qpos: Poses in the scene's model, one per time.
        dt: Time between two poses [s].

    Raises:
        InputError: The scene has no such object, or the poses do not fit it.
    """
    import copy

    fields, index = scene.object_fields, scene.object_index(object_name)
    model = copy.copy(scene.model)
    model.geom_pos[:] = fields.geom_pos[index]
    pieces = scene.addresses.object_geoms
    own = np.array([model.geom(g).name.rpartition("_")[0] == object_name for g in pieces])
    model.geom_rgba[pieces[~own], 3] = 0.0
    return record(model, qpos, dt, robot=scene.robot.identity)


def save_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Writes a trajectory as an archive, complete or not at all."""
    header = _Header(trajectory.mujoco_version, trajectory.dt, trajectory.focus, trajectory.robot)
    model = np.frombuffer(trajectory.model, np.uint8)
    write_archive(path, _KIND, header, {"model": model, "qpos": trajectory.qpos})


def load_trajectory(path: str | Path) -> Trajectory:
    """Reads a trajectory.

    Raises:
        FileError: The file is missing, damaged, or no trajectory.
    """
    header, arrays = read_archive(path, _KIND)
    return Trajectory(model=arrays["model"].tobytes(), qpos=arrays["qpos"], **vars(header))


@dataclass(frozen=True)
class _Header(Settings):
    mujoco_version: str
    dt: Positive
    focus: str
    robot: RobotIdentity | None = FIRST_ROBOT
    """Absent in version 1."""


def _check(path: Path, header: _Header, arrays: Arrays) -> None:
    if not arrays["qpos"].size:
        raise FileError(path, f"qpos {arrays['qpos'].shape}", "one pose or more")


def _from_version_1(header: Header, arrays: Arrays) -> tuple[Header, Arrays]:
    """Without header and checksum."""
    fields = {name: arrays[name].item() for name in ("mujoco_version", "dt", "focus")}
    return fields, {name: arrays[name] for name in ("model", "qpos")}


_KIND = ArchiveKind(
    format="mjx_grasp trajectory",
    version=2,
    header=_Header,
    arrays={"model": "uint8 bytes", "qpos": "float64 t nq"},
    check=_check,
    older={1: _from_version_1},
)
