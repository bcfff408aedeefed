"""Checked files: arrays and a header in one `.npz`, with format, version and checksum.

Besides the arrays an archive has one member, `header`: JSON text with the name of the format, its
version, the checksum and the fields of the kind's header class. The checksum is SHA-256 over the
rest of the header and every array's name, type, shape and content. Nothing is pickled, a file is
written whole or not at all, and what is read is checked as what is written is.

Files outlive code: whoever changes what a kind holds raises its version and adds to `older` how a
file of the version before is read.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import Settings, from_record, to_record

H = TypeVar("H", bound=Settings)
Arrays = Mapping[str, np.ndarray]
Header = Mapping[str, Any]
"""A header as it stands in the file."""

_OWN = ("format", "version", "checksum")
"""What the archive itself puts into a header."""


class ChecksumError(Exception):
    """The content of a file is not what was written."""


@dataclass(frozen=True)
class ArchiveKind(Generic[H]):
    """What the files of one format hold."""

    format: str
    """Name of the format; part of every file."""
    version: int
    """The version that is written."""
    header: type[H]
    """The class of the header."""
    arrays: Mapping[str, str]
    """Type and shape of each array, such as 'float32 n 3'. A length with a name is the same
    wherever the name stands; `_` is any. Names may be patterns: `weight_*`."""
    check: Callable[[Path, H, Arrays], None] = lambda path, header, arrays: None
    """Raises a FileError if the content makes no sense."""
    older: Mapping[int, Callable[[Header, Arrays], tuple[Header, Arrays]]] = field(
        default_factory=dict
    )
    """How header fields and arrays of today are got from what a file of an older version holds;
    raises a ChecksumError if that is damaged."""


def write_archive(
    path: str | Path, kind: ArchiveKind[H], header: H, arrays: Mapping[str, ArrayLike]
) -> None:
    """Writes an archive of the present version, all or nothing.

    Args:
        path: The file.
        kind: Its format.
        header: Everything that is no array.
        arrays: By name; converted to the types of the kind.

    Raises:
        FileError: What would be written is not what this kind of file holds.
    """
    layouts = _layouts(Path(path), kind, arrays)
    typed: dict[str, Any] = {
        name: np.asarray(arrays[name], dtype, order="C") for name, (dtype, *_) in layouts.items()
    }
    _check(Path(path), kind, header, typed)
    record = {"format": kind.format, "version": kind.version, **to_record(header)}
    said = json.loads(json.dumps(record))
    text = json.dumps(said | {"checksum": checksum(said, typed)})
    with replacing(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, header=np.array(text), **typed)


def read_archive(path: str | Path, kind: ArchiveKind[H]) -> tuple[H, dict[str, Any]]:
    """Reads an archive of the present version or of one before.

    Args:
        path: The file.
        kind: The format that it should have.

    Returns:
        Header and arrays, as the present version has them.

    Raises:
        FileError: The file is missing, damaged, of another format, of a newer version, or holds
            what makes no sense.
    """
    path, expected = Path(path), f"a {kind.format} file"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(path, (error.strerror or "an unreadable file").lower(), expected) from None
    try:
        header, arrays = _members(content)
    except Exception as error:
        # Depending on where it is damaged, reading a zip file raises nearly anything.
        raise FileError(path, "a damaged or foreign file", expected) from error
    name, version = _label(header, arrays)
    if name != kind.format:
        raise FileError(path, f"another kind of file ({name})", expected)
    readers = {kind.version: checked, **kind.older}
    if version not in readers:
        known = f"version {kind.version} or before; newer ones need a newer package"
        raise FileError(path, f"version {version}", known)
    try:
        fields, present = readers[version](header, arrays)
        read = from_record(kind.header, fields, "header")
    except ChecksumError:
        found = "content that does not match its checksum"
        raise FileError(path, found, "an undamaged file") from None
    except InputError as error:
        raise FileError(path, f"{error.field} = {error.found!r}", error.expected) from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise FileError(path, f"incomplete content ({error!r})", expected) from None
    _check(path, kind, read, present)
    return read, dict(present)


def checked(header: Header, arrays: Arrays) -> tuple[Header, Arrays]:
    """The header's fields without what the archive adds to them, and the arrays.

    Raises:
        ChecksumError: The content does not match the checksum.
    """
    if checksum(header, arrays) != header["checksum"]:
        raise ChecksumError
    return {key: value for key, value in header.items() if key not in _OWN}, arrays


def checksum(header: Header, arrays: Arrays) -> str:
    """SHA-256 over all that an archive says, its checksum apart."""
    said = {key: value for key, value in header.items() if key != "checksum"}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _members(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of an npz file; the first trajectories have no header."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: np.asarray(file[name]) for name in file.files}
    text = arrays.pop("header", np.array("{}"))
    # The first policies have the text as bytes.
    header = json.loads(text.tobytes() if text.dtype == np.uint8 else str(text))
    if not isinstance(header, dict):
        raise ValueError("header")
    return header, arrays


def _label(header: Header, arrays: Arrays) -> tuple[str, int | None]:
    """Format and version; in the first policies and trajectories they are one word."""
    name = str(header.get("format", arrays.get("schema", "of no known format")))
    name, _, number = name.partition("/")
    version = int(number) if number.isdecimal() else header.get("version")
    return name.replace(".", " "), version if isinstance(version, int) else None


def _layouts(path: Path, kind: ArchiveKind[H], arrays: Iterable[str]) -> dict[str, list[str]]:
    """Type and lengths that each array should have.

    Raises:
        FileError: An array is missing, or not of this kind.
    """
    layouts = {}
    for name in arrays:
        pattern = next((p for p in kind.arrays if fnmatchcase(name, p)), None)
        if pattern is None:
            raise FileError(path, f"an array {name}", f"the arrays {', '.join(kind.arrays)}")
        layouts[name] = kind.arrays[pattern].split()
    missing = [name for name in kind.arrays if "*" not in name and name not in arrays]
    if missing:
        raise FileError(path, f"no array {', '.join(missing)}", f"those of a {kind.format}")
    return layouts


def _check(path: Path, kind: ArchiveKind[H], header: H, arrays: Arrays) -> None:
    """Names, types, shapes, finite numbers, and what the kind asks for besides."""
    lengths: dict[str, int] = {}
    for name, (dtype, *shape) in _layouts(path, kind, arrays).items():
        array = arrays[name]
        for length, found in zip(shape, array.shape, strict=False):
            if length.isidentifier() and length != "_":
                lengths.setdefault(length, found)
        wanted = [str(lengths.get(length, length)) for length in shape]
        fits = [n in ("_", str(m)) for n, m in zip(wanted, array.shape, strict=False)]
        if array.dtype != dtype or array.ndim != len(shape) or not all(fits):
            expected = f"{dtype} ({', '.join(wanted)})"
            raise FileError(path, f"{name} {array.dtype} {array.shape}", expected)
        if not np.isfinite(array).all():
            raise FileError(path, f"{name} with numbers that are not finite", "finite numbers")
    kind.check(path, header, arrays)


def packed(arrays: Mapping[str, np.ndarray]) -> str:
    """Arrays as text for a journal's line, to the bit."""
    file, named = io.BytesIO(), dict[str, Any](arrays)
    np.savez_compressed(file, **named)
    return base64.b64encode(file.getvalue()).decode()


def unpacked(text: str) -> dict[str, Any]:
    """What `packed` was given."""
    with np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False) as arrays:
        return dict(arrays)
