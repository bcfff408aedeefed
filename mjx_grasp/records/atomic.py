"""Files: never left half-written, refused before the work if they cannot be, read with care."""

from __future__ import annotations

import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from mjx_grasp.errors import FileError, InputError


@contextmanager
def replacing(path: str | Path, *, new: bool = False) -> Iterator[Path]:
    """Yields a temporary path in the target's folder; on success it replaces ``path`` atomically.

    The temporary name keeps the suffix, so that writers which look at it work. When the block
    raises, the target is untouched and the temporary file is removed. Of a link it is the file
    behind it that is replaced; modes and, where this is allowed, owners stay as they are.

    Args:
        path: The target.
        new: Whether it may not be there yet.

    Raises:
        FileExistsError: It is, though it may not; of several that write at once, to all but one.
    """
    path = Path(path)
    target = _behind_link(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _as_before(temporary, target)
        if new:
            target.open("x").close()
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _behind_link(path: Path) -> Path:
    """What a link leads to, there or not; any other path as it is."""
    return path.resolve() if path.is_symlink() else path


def _as_before(temporary: Path, path: Path) -> None:
    """Gives a file mode and owner of the one that it replaces; whose it is may write it."""
    if not path.exists():
        temporary.chmod(0o644)
        return
    before = path.stat()
    with suppress(OSError):  # only root may give files away
        os.chown(temporary, before.st_uid, before.st_gid)
    temporary.chmod(stat.S_IMODE(before.st_mode) | stat.S_IWUSR)


def copy_file(source: str | Path, path: str | Path) -> None:
    """Copies a file, complete or not at all."""
    with replacing(path) as temporary:
        shutil.copyfile(source, temporary)


def check_writable(field: str, path: str | Path) -> None:
    """Makes sure that a result can be written, before the work that it is the result of.

    Args:
        field: The setting that names it.
        path: The file that will be written, in a folder that is there.

    Raises:
        InputError: It cannot be.
    """
    try:
        path = _behind_link(Path(path))
    except (OSError, RuntimeError):
        raise InputError(field, str(path), "a file, not a link that leads to itself") from None
    if not path.absolute().parent.exists():
        found = f"{path}, in a folder that does not exist ({path.parent})"
        raise InputError(field, found, "a file in a folder that is there")
    try:
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder")
        tempfile.TemporaryFile(dir=path.absolute().parent).close()
    except OSError as error:
        expected = f"a file that can be written ({error.strerror})"
        raise InputError(field, str(path), expected) from None


def check_replaceable(field: str, path: str | Path, schemas: Collection[str]) -> None:
    """Makes sure that results can be written, and that what they replace is of their kind.

    Args:
        field: The setting that names it.
        path: The file that will be written, in a folder that is there.
        schemas: What such files say that they are.

    Raises:
        InputError: It cannot be written, or is there and is something else.
    """
    check_writable(field, path)
    if Path(path).exists():
        try:
            schema = read_json(path, "results").get("schema", "no schema")
        except FileError as error:
            schema = error.found
        if schema not in schemas:
            expected = f"a new file name, or a file of {' or '.join(schemas)} to replace"
            raise InputError(field, f"{path}, which is another file ({schema})", expected)


def check_new_folder(field: str, folder: str | Path) -> None:
    """Makes sure that results can be written to a folder, which need not be there yet.

    Args:
        field: The setting that names it.
        folder: The folder; it is made, with those above it, when something is written.

    Raises:
        InputError: They cannot be.
    """
    path = Path(folder).absolute()
    try:
        tempfile.TemporaryFile(dir=next(p for p in (path, *path.parents) if p.exists())).close()
    except OSError as error:
        expected = f"a folder to which results can be written ({error.strerror})"
        raise InputError(field, str(folder), expected) from None


def read_json(path: str | Path, expected: str) -> dict[str, Any]:
    """Reads an object of JSON.

    Args:
        path: The file.
        expected: What it should hold, for the error.

    Raises:
        FileError: It is missing, unreadable, no JSON, nested too deep, or no object.
    """
    try:
        document = json.loads(Path(path).read_text())
    except FileNotFoundError:
        raise FileError(path, "no such file", expected) from None
    except OSError as error:
        raise FileError(path, error.strerror or "an unreadable file", expected) from None
    except ValueError as error:
        raise FileError(path, f"no JSON ({error})", expected) from None
    except RecursionError:
        raise FileError(path, "JSON that is nested too deep", expected) from None
    if not isinstance(document, dict):
        raise FileError(path, f"a JSON {type(document).__name__}", f"{expected}, a JSON object")
    return document


def write_json(path: str | Path, content: Any, *, strict: bool = False, new: bool = False) -> None:
    """Writes JSON, whole or not at all; paths and the like become text.

    Args:
        path: The file.
        content: As `json.dumps` takes it.
        strict: Whether what JSON does not know is refused: numbers that are none, and what would
            become text.
        new: As of `replacing`.
    """
    dump = partial(json.dumps, allow_nan=False) if strict else partial(json.dumps, default=str)
    with replacing(path, new=new) as temporary:
        temporary.write_text(_json(content, "\n", dump) + "\n")


def _json(value: Any, line: str, dump: Callable[[Any], str]) -> str:
    """As with an indent of one, but what is long where there are many trials is a line: lists of
    words or numbers, and in lists whatever has names and is of those alone."""
    inner = line + " "

    def item(x: Any) -> str:
        row = isinstance(x, dict) and not any(
            isinstance(y, dict | list | tuple) for y in x.values()
        )
        return dump(x) if row else _json(x, inner, dump)

    if isinstance(value, dict) and value:
        # json.dumps knows what may be a key.
        named = ((json.dumps({k: 0})[1:-4], _json(x, inner, dump)) for k, x in value.items())
        return "{" + ",".join(f"{inner}{name}: {text}" for name, text in named) + line + "}"
    if isinstance(value, list | tuple) and any(isinstance(x, dict | list | tuple) for x in value):
        return "[" + ",".join(inner + item(x) for x in value) + line + "]"
    return dump(value)
