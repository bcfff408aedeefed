"""Nothing is ever left half-written: write beside the target, then rename over it."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mjx_grasp.errors import InputError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path in the target's folder; on success it replaces ``path`` atomically.

    The temporary name keeps the suffix, so that writers which look at it work. When the block
    raises, the target is untouched and the temporary file is removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(field: str, path: str | Path) -> None:
    """Makes sure that a result can be written, before the work that it is the result of.

    Args:
        field: The setting that names it.
        path: The file that will be written; folders to it are made then.

    Raises:
        InputError: It cannot be.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder")
        folder = next(p for p in path.absolute().parents if p.exists())
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        expected = f"a file that can be written ({error.strerror})"
        raise InputError(field, str(path), expected) from None


def write_json(path: str | Path, content: Any) -> None:
    """Writes JSON, whole or not at all; paths and the like become text."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, default=str) + "\n")


def as_json(content: Any) -> Any:
    """What a file of JSON gives back of the content; paths and the like become text."""
    return json.loads(json.dumps(content, default=str))
