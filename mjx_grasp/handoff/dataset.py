"""The handoff dataset: states from which a grasp is closed, in one checked file."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import replacing

if TYPE_CHECKING:
    from mjx_grasp.objects.model import ObjectModel

FORMAT = "mjx_grasp handoff set"
VERSION = 1
KINDS = ("ik", "reached")

# Of every array: the shape behind the leading dimension (None: any length), and the type.
_SCHEMA: dict[str, tuple[tuple[int | None, ...], type]] = {
    "object_index": ((), np.int32),
    "object_pos": ((3,), np.float32),
    "object_quat": ((4,), np.float32),
    "q": ((None,), np.float32),
    "target_pos": ((3, 3), np.float32),
    "target_normal": ((3, 3), np.float32),
    "score": ((), np.float32),
    "residual": ((3,), np.float32),
}
_NAMES = ("object_names", "object_content_hash", "kind")


@partial(jax.tree_util.register_dataclass, data_fields=list(_SCHEMA), meta_fields=list(_NAMES))
@dataclass(frozen=True)
class HandoffSet:
    """Pre-grasp states; arrays have N states in front. World frame, SI units.

    Targets are those of thumb, index and middle finger: the contacts, not the standoffs. A pytree
    whose leaves are the arrays.
    """

    object_index: Int[np.ndarray, " n"]  # into object_names
    object_pos: Float[np.ndarray, "n 3"]  # object origin, m
    object_quat: Float[np.ndarray, "n 4"]  # w-x-y-z
    q: Float[np.ndarray, "n joints"]  # robot joints, model order, rad
    target_pos: Float[np.ndarray, "n 3 3"]  # m
    target_normal: Float[np.ndarray, "n 3 3"]  # outward unit normals
    score: Float[np.ndarray, " n"]  # of the heatmap candidate
    residual: Float[np.ndarray, "n 3"]  # distance of the tip frames from the standoff targets, m
    object_names: tuple[str, ...]
    object_content_hash: tuple[str, ...]  # of the objects as they were when the states were made
    kind: str  # 'ik', or 'reached': the end of the reaching controller

    def __len__(self) -> int:
        return len(self.object_index)

    def take(self, which: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> HandoffSet:
        """The states of these indices, or where a mask is true; names stay."""
        return replace(self, **{name: getattr(self, name)[which] for name in _SCHEMA})

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
        """Splits every object's states at random into training and evaluation.

        Args:
            eval_share: Share of each object's states that goes to the second set, rounded; an
                object with several states keeps at least one on either side.
            seed: Of the split.

        Raises:
            InputError: The share is not between 0 and 1.
        """
        if not 0 < eval_share < 1:
            raise InputError("eval_share", eval_share, "a number between 0 and 1")
        held = np.zeros(len(self), dtype=bool)
        for index, name in enumerate(self.object_names):
            rows = np.flatnonzero(self.object_index == index)
            count = round(eval_share * len(rows))
            if len(rows) > 1:
                count = min(max(count, 1), len(rows) - 1)
            # By name: an object is split alike whatever the other objects of the set are.
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            held[rng.permutation(rows)[:count]] = True
        return self.take(~held), self.take(held)

    def save(self, path: str | Path) -> None:
        """Writes the set as a compressed ``.npz`` with version and checksum, all or nothing."""
        arrays: dict[str, np.ndarray] = {
            name: np.ascontiguousarray(getattr(self, name), dtype)
            for name, (_, dtype) in _SCHEMA.items()
        }
        header = {
            "format": FORMAT,
            "version": VERSION,
            "object_names": list(self.object_names),
            "object_content_hash": list(self.object_content_hash),
            "kind": self.kind,
        }
        _check(path, arrays, header)
        header["checksum"] = _checksum(arrays, header)
        with replacing(path) as temporary, temporary.open("wb") as file:
            members: dict[str, Any] = {"header": np.array(json.dumps(header)), **arrays}
            np.savez_compressed(file, **members)


def merge(sets: Sequence[HandoffSet]) -> HandoffSet:
    """One set of all states; objects of the same name must have the same content.

    Raises:
        InputError: No sets, different kinds, or an object that differs between them.
    """
    if not sets or len({s.kind for s in sets}) != 1:
        raise InputError("sets", [s.kind for s in sets], "one or more sets of the same kind")
    hashes: dict[str, str] = {}
    for s in sets:
        for name, content in zip(s.object_names, s.object_content_hash, strict=True):
            if hashes.setdefault(name, content) != content:
                raise InputError("sets", f"{name} with two contents", "the same object throughout")
    names = tuple(hashes)
    arrays = {name: np.concatenate([getattr(s, name) for s in sets]) for name in _SCHEMA}
    arrays["object_index"] = np.concatenate(
        [np.array([names.index(n) for n in s.object_names], np.int32)[s.object_index] for s in sets]
    )
    return HandoffSet(
        **arrays,
        object_names=names,
        object_content_hash=tuple(hashes.values()),
        kind=sets[0].kind,
    )


def load_handoffs(path: str | Path, objects: Sequence[ObjectModel] | None = None) -> HandoffSet:
    """Reads a handoff set and checks it.

    Args:
        path: File written by :meth:`HandoffSet.save`.
        objects: If given, the objects of these names must be the very ones of the file: states
            made for another mesh are worth nothing.

    Raises:
        FileError: Missing, damaged, foreign, of a newer version, or made for other objects.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise FileError(path, "another kind of file", f"a {FORMAT}")
            if header.get("version") != VERSION:
                found = f"version {header.get('version')}"
                raise FileError(path, found, f"version {VERSION}; newer ones need a newer package")
            arrays = {name: file[name] for name in _SCHEMA}
    except FileError:
        raise
    except FileNotFoundError:
        raise FileError(path, "no file", f"a {FORMAT}") from None
    except (KeyError, json.JSONDecodeError):
        raise FileError(path, "another kind of file", f"a {FORMAT}") from None
    except Exception as error:
        # Depending on where it is damaged, reading a zip file raises nearly anything.
        raise FileError(path, "a damaged or foreign file", f"a {FORMAT}") from error
    if _checksum(arrays, header) != header.get("checksum"):
        raise FileError(path, "content that does not match its checksum", "an undamaged file")
    _check(path, arrays, header)
    handoffs = HandoffSet(
        **arrays,
        object_names=tuple(header["object_names"]),
        object_content_hash=tuple(header["object_content_hash"]),
        kind=header["kind"],
    )
    known = dict(zip(handoffs.object_names, handoffs.object_content_hash, strict=True))
    for obj in objects or ():
        if known.get(obj.name, obj.content_hash) != obj.content_hash:
            raise FileError(path, f"states of another {obj.name}", "those of the mesh in use")
    return handoffs


def _checksum(arrays: Mapping[str, np.ndarray], header: Mapping[str, object]) -> str:
    """SHA-256 over all that the file says."""
    digest = hashlib.sha256()
    said = {key: header.get(key) for key in ("format", "version", *_NAMES)}
    digest.update(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check(path: str | Path, arrays: Mapping[str, np.ndarray], header: Mapping) -> None:
    """Shapes, finite numbers, indices and names that fit each other."""
    count = len(arrays["object_index"])
    for name, (tail, dtype) in _SCHEMA.items():
        array = arrays[name]
        fits = array.ndim == 1 + len(tail) and len(array) == count and array.dtype == dtype
        if not fits or any(n not in (None, m) for n, m in zip(tail, array.shape[1:], strict=True)):
            shape = (count, *("any" if n is None else n for n in tail))
            raise FileError(
                path, f"{name} {array.dtype} {array.shape}", f"{dtype.__name__} {shape}"
            )
        if not np.isfinite(array).all():
            raise FileError(path, f"{name} with numbers that are not finite", "finite numbers")
    names, index = header["object_names"], arrays["object_index"]
    if len(names) != len(header["object_content_hash"]) or len(set(names)) != len(names):
        raise FileError(path, f"{len(names)} object names", "different names with a hash each")
    if count and (index.min() < 0 or index.max() >= len(names)):
        raise FileError(path, f"object index up to {index.max()}", f"below {len(names)}")
    if header["kind"] not in KINDS:
        raise FileError(path, f"kind {header['kind']!r}", f"one of {', '.join(KINDS)}")
