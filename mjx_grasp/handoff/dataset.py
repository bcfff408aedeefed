"""The handoff dataset: states from which a grasp is closed, in one checked file."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.records.archive import (
    ArchiveKind,
    Arrays,
    Header,
    checked,
    read_archive,
    write_archive,
)
from mjx_grasp.records.settings import Settings
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity, check_robot

ARRAYS = {
    "object_index": "int32 n",
    "object_pos": "float32 n 3",
    "object_quat": "float32 n 4",
    "q": "float32 n joints",
    "target_pos": "float32 n 3 3",
    "target_normal": "float32 n 3 3",
    "score": "float32 n",
    "residual": "float32 n 3",
    "midpoint": "float32 n",
    "reached": "bool n",
}
"""Of a set: type and shape of each."""
_NAMES = ("object_names", "object_content_hash", "robot")
KINDS = ("ik", "reached", "mixed")
"""Of a set: postures of inverse kinematics, ends of the reaching controller, or both."""
UNKNOWN_M = -1.0
"""The midpoint's error in sets that do not say it, those before version 3."""
_ROUNDING = 1e-3
"""By how much unit vectors and scores may be off."""
_HIGHEST_M, _FARTHEST_M = 2.0, 1.0
"""The most that an object is above the table, and a target away from its object."""
_BEYOND_LIMITS = 1e-3
"""How far joints may be beyond their range [rad or m]."""


@partial(jax.tree_util.register_dataclass, data_fields=list(ARRAYS), meta_fields=list(_NAMES))
@dataclass(frozen=True)
class HandoffSet:
    """Pre-grasp states; arrays have N states in front. World frame, SI units.

    Targets are those of thumb, index and middle finger: the contacts, not the standoffs. A pytree
    whose leaves are the arrays.
    """

    object_index: Int[np.ndarray, " n"]
    """Index into the names."""
    object_pos: Float[np.ndarray, "n 3"]
    """Object origin [m]."""
    object_quat: Float[np.ndarray, "n 4"]
    """w-x-y-z."""
    q: Float[np.ndarray, "n joints"]
    """Robot joints, model order [rad]."""
    target_pos: Float[np.ndarray, "n 3 3"]
    """Contacts [m]."""
    target_normal: Float[np.ndarray, "n 3 3"]
    """Outward unit normals there."""
    score: Float[np.ndarray, " n"]
    """Of the heatmap candidate."""
    residual: Float[np.ndarray, "n 3"]
    """Distance of the tip frames from the standoff targets [m]."""
    midpoint: Float[np.ndarray, " n"]
    """The same of their midpoint, ½ thumb + ¼ index + ¼ middle; `UNKNOWN_M` in old files [m]."""
    reached: Bool[np.ndarray, " n"]
    """Whether it is the end of the reaching controller; else inverse kinematics found it."""
    object_names: tuple[str, ...]
    object_content_hash: tuple[str, ...]
    """Of the objects as they were when the states were made."""
    robot: RobotIdentity = FIRST_ROBOT
    """Whose joints these are."""

    def __len__(self) -> int:
        return len(self.object_index)

    @property
    def kind(self) -> str:
        """What states there are, one of `KINDS`; 'ik' where there are none."""
        return kind_of(self.reached)

    def take(self, which: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> HandoffSet:
        """The states of these indices, or where a mask is true; names stay."""
        return replace(self, **{name: getattr(self, name)[which] for name in ARRAYS})

    def select(self, names: Sequence[str]) -> HandoffSet:
        """The states of these objects alone; the set's names become these, in this order.

        Raises:
            InputError: The set does not know an object, or one is named twice.
        """
        unknown = [name for name in names if name not in self.object_names]
        if unknown or len(set(names)) != len(names):
            raise InputError("names", list(names), f"some of {', '.join(self.object_names)}")
        place = np.array([list(names).index(n) if n in names else -1 for n in self.object_names])
        index = place[self.object_index].astype(np.int32)
        hashes = dict(zip(self.object_names, self.object_content_hash, strict=True))
        chosen = replace(
            self,
            object_index=index,
            object_names=tuple(names),
            object_content_hash=tuple(hashes[name] for name in names),
        )
        return chosen.take(index >= 0)

    def counts(self) -> dict[str, int]:
        """How many states each object has."""
        counts = np.bincount(self.object_index, minlength=len(self.object_names))
        return dict(zip(self.object_names, counts.tolist(), strict=True))

    def split(self, eval_share: float = 0.25, seed: int = 0) -> tuple[HandoffSet, HandoffSet]:
        """Splits every object's states of each kind at random into training and evaluation.

        Args:
            eval_share: Share of each object's states of one kind that goes to the second set,
                rounded; with several there is at least one on either side.
            seed: Of the split.

        Raises:
            InputError: The share is not between 0 and 1.
        """
        if not 0 < eval_share < 1:
            raise InputError("eval_share", eval_share, "a number between 0 and 1")
        held = np.zeros(len(self), dtype=bool)
        for index, name in enumerate(self.object_names):
            # By name: an object is split alike whatever the other objects of the set are.
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            for kind in (False, True):
                rows = np.flatnonzero((self.object_index == index) & (self.reached == kind))
                count = round(eval_share * len(rows))
                if len(rows) > 1:
                    count = min(max(count, 1), len(rows) - 1)
                held[rng.permutation(rows)[:count]] = True
        return self.take(~held), self.take(held)

    def save(self, path: str | Path) -> None:
        """Writes the set as an archive, all or nothing.

        Raises:
            InputError: A name is impossible.
            FileError: Arrays do not fit each other, or hold no such states.
        """
        header = _Header(**{name: getattr(self, name) for name in (*_NAMES, "kind")})
        write_archive(path, _KIND, header, {name: getattr(self, name) for name in ARRAYS})


def kind_of(reached: Bool[np.ndarray, " n"]) -> str:
    """What states are together, one of `KINDS`."""
    if not reached.any():
        return "ik"
    return "reached" if reached.all() else "mixed"


def merge(sets: Sequence[HandoffSet]) -> HandoffSet:
    """One set of all states; objects of the same name must have the same content.

    The digest of the robot is known only if that of every set is.

    Raises:
        InputError: No sets, different robots, or an object that differs between them.
    """
    if not sets:
        raise InputError("sets", "none", "one or more sets")
    robots = sorted({s.robot for s in sets}, key=lambda robot: robot.digest or "")
    if not all(a.agrees(b) for a in robots for b in robots):
        raise InputError("sets", [str(robot) for robot in robots], "states of one robot")
    hashes: dict[str, str] = {}
    for s in sets:
        for name, content in zip(s.object_names, s.object_content_hash, strict=True):
            if hashes.setdefault(name, content) != content:
                raise InputError("sets", f"{name} with two contents", "the same object throughout")
    names = tuple(hashes)
    arrays = {name: np.concatenate([getattr(s, name) for s in sets]) for name in ARRAYS}
    arrays["object_index"] = np.concatenate(
        [np.array([names.index(n) for n in s.object_names], np.int32)[s.object_index] for s in sets]
    )
    return HandoffSet(
        **arrays,
        object_names=names,
        object_content_hash=tuple(hashes.values()),
        robot=robots[0],
    )


def load_handoffs(
    path: str | Path,
    objects: Sequence[ObjectModel] | None = None,
    robot: RobotSpec | None = None,
) -> HandoffSet:
    """Reads a handoff set and checks it.

    Args:
        path: File written by :meth:`HandoffSet.save`.
        objects: If given, the objects of these names must be the very ones of the file: states
            made for another mesh are worth nothing.
        robot: If given, the states must be of this robot and within its joints' ranges.

    Raises:
        FileError: Missing, damaged, foreign, of a newer version, with states that cannot be, or
            made for other objects or another robot.
    """
    header, arrays = read_archive(path, _KIND)
    handoffs = HandoffSet(**arrays, **{name: getattr(header, name) for name in _NAMES})
    known = dict(zip(handoffs.object_names, handoffs.object_content_hash, strict=True))
    for obj in objects or ():
        if known.get(obj.name, obj.content_hash) != obj.content_hash:
            raise FileError(path, f"states of another {obj.name}", "those of the mesh in use")
    if robot is not None:
        check_handoffs(path, handoffs, robot)
    return handoffs


def check_handoffs(path: str | Path, handoffs: HandoffSet, robot: RobotSpec) -> None:
    """Makes sure that the states of a file are a robot's.

    Args:
        path: The file.
        handoffs: What it holds.
        robot: The robot; which of its fingers are fixed does not matter.

    Raises:
        FileError: They are of another robot, or a joint is beyond its range.
    """
    check_robot(path, handoffs.robot, robot.identity)
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    if handoffs.q.shape[1] != model.njnt:
        found = f"states of {handoffs.q.shape[1]} joints"
        raise FileError(path, found, f"{model.njnt}, those of {robot.name}")
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf]).T
    beyond = np.maximum(low - handoffs.q, handoffs.q - high) > _BEYOND_LIMITS
    for state, joint in np.argwhere(beyond)[:1]:
        found = f"{model.joint(joint).name} of state {state} at {handoffs.q[state, joint]:.4g}"
        raise FileError(path, found, f"{low[joint]:.4g} to {high[joint]:.4g}")


@dataclass(frozen=True)
class _Header(Settings):
    object_names: tuple[str, ...]
    object_content_hash: tuple[str, ...]
    robot: RobotIdentity = FIRST_ROBOT
    """Absent in version 1."""
    kind: Literal["ik", "reached", "mixed"] = "ik"
    """Of all states together; for whoever reads the header alone."""


def _before_kinds(header: Header, arrays: Arrays) -> tuple[Header, Arrays]:
    """Of versions 1 and 2, whose states are all of one kind."""
    header, arrays = checked(header, arrays)
    n = len(arrays["residual"])
    reached = np.full(n, header["kind"] == "reached")
    return header, {**arrays, "midpoint": np.full(n, UNKNOWN_M, np.float32), "reached": reached}


def _check(path: Path, header: _Header, arrays: Arrays) -> None:
    """Names and indices that fit each other, and states that can be."""
    names, index = header.object_names, arrays["object_index"]
    if len(names) != len(header.object_content_hash) or len(set(names)) != len(names):
        raise FileError(path, f"{len(names)} object names", "different names with a hash each")
    if len(index) and (index.min() < 0 or index.max() >= len(names)):
        raise FileError(path, f"object index up to {index.max()}", f"below {len(names)}")
    # An empty set is of whatever kind it says.
    if len(index) and header.kind != (kind := kind_of(arrays["reached"])):
        raise FileError(path, f"the kind {header.kind} of states that are {kind}", "their own kind")
    midpoint = arrays["midpoint"]
    height = arrays["object_pos"][:, 2]
    away = np.linalg.norm(arrays["target_pos"] - arrays["object_pos"][:, None], axis=-1)
    for name, wrong, expected in (
        ("object_pos", (height <= 0) | (height > _HIGHEST_M), "an object on or above the table"),
        ("object_quat", _no_unit(arrays["object_quat"]), "unit quaternions"),
        ("target_normal", _no_unit(arrays["target_normal"]), "unit normals"),
        ("target_pos", away > _FARTHEST_M, f"targets within {_FARTHEST_M:g} m of the object"),
        ("score", np.abs(arrays["score"] - 0.5) > 0.5 + _ROUNDING, "scores from 0 to 1"),
        ("residual", arrays["residual"] < 0, "distances, 0 m or more"),
        ("midpoint", (midpoint < 0) & (midpoint != UNKNOWN_M), "distances, 0 m or more"),
    ):
        for place in np.argwhere(wrong)[:1]:
            shown = np.array2string(arrays[name][tuple(place)], precision=4)
            raise FileError(path, f"{name} of state {place[0]} with {shown}", expected)


def _no_unit(vectors: Float[np.ndarray, "*b d"]) -> Bool[np.ndarray, "*b"]:
    return np.abs(np.linalg.norm(vectors, axis=-1) - 1.0) > _ROUNDING


_KIND = ArchiveKind(
    format="mjx_grasp handoff set",
    version=3,
    header=_Header,
    arrays=ARRAYS,
    check=_check,
    older={1: _before_kinds, 2: _before_kinds},
)
