"""A recorded motion in one file, from which it can be rendered anywhere: model, poses, time."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import replacing

if TYPE_CHECKING:
    import mujoco

    from mjx_grasp.sim.scene import Scene

SCHEMA = "mjx_grasp.trajectory/1"
_FIELDS = ("schema", "model", "mujoco_version", "qpos", "dt", "focus")


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

    def __post_init__(self):
        if self.qpos.ndim != 2 or not self.qpos.size or not np.isfinite(self.qpos).all():
            raise InputError("Trajectory.qpos", self.qpos.shape, "finite numbers of shape [t, nq]")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError("Trajectory.dt", self.dt, "a positive time in seconds")

    @property
    def seconds(self) -> float:
        """Time from the first pose to the last [s]."""
        return self.dt * (len(self.qpos) - 1)


def record(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "t nq"], dt: float, focus: str = "object"
) -> Trajectory:
    """A trajectory of a compiled model.

    Args:
        model: The model; the trajectory keeps a copy.
        qpos: One pose per time.
        dt: Time between two poses [s].
        focus: Name of the body that a camera should follow.

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
    return Trajectory(buffer.tobytes(), mujoco.__version__, qpos, float(dt), focus)


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
    return record(model, qpos, dt)


def save_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Writes a trajectory as a compressed npz file, complete or not at all."""
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(
            stream,
            schema=SCHEMA,
            model=np.frombuffer(trajectory.model, np.uint8),
            mujoco_version=trajectory.mujoco_version,
            qpos=trajectory.qpos,
            dt=trajectory.dt,
            focus=trajectory.focus,
        )


def load_trajectory(path: str | Path) -> Trajectory:
    """Reads a trajectory.

    Raises:
        FileError: The file is missing, damaged, or no trajectory.
    """
    expected = "a trajectory written by mjx_grasp.evaluation.trajectory"
    try:
        content = io.BytesIO(Path(path).read_bytes())
    except OSError as error:
        raise FileError(path, error.strerror or "an unreadable file", expected) from None
    try:
        with np.load(content, allow_pickle=False) as file:
            missing = [name for name in _FIELDS if name not in file]
            fields = {name: file[name] for name in _FIELDS if name in file}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, AttributeError, TypeError):
        raise FileError(path, "no readable npz archive", expected) from None
    if missing:
        raise FileError(path, f"no field {', '.join(missing)}", expected)
    if str(fields["schema"]) != SCHEMA:
        raise FileError(path, f"schema {str(fields['schema'])!r}", f"schema {SCHEMA!r}")
    try:
        return Trajectory(
            model=np.asarray(fields["model"], np.uint8).tobytes(),
            mujoco_version=str(fields["mujoco_version"]),
            qpos=np.asarray(fields["qpos"], float),
            dt=float(fields["dt"]),
            focus=str(fields["focus"]),
        )
    except (InputError, ValueError, TypeError) as error:
        raise FileError(path, str(error), expected) from None
