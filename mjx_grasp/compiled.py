"""Where JAX keeps what commands compile, so that it is compiled once and not by each of them."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import time
from contextlib import suppress
from pathlib import Path

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
_KEPT_S = 30 * 24 * 3600.0


def keep_compiled(folder: Path | None = None) -> None:
    """Names a folder to JAX, for this process and those that it begins, unless JAX has one.

    What was written a month ago and more is removed from it. Where nothing can be written, nothing
    is kept.

    Args:
        folder: Where to; by default one for this processor in ``~/.cache/mjx_grasp/compiled``.
    """
    if VARIABLE in os.environ:
        return
    try:
        own = folder or Path.home() / ".cache" / "mjx_grasp" / "compiled" / _processor()
        own.mkdir(parents=True, exist_ok=True)
        _forget(own)
    except (OSError, RuntimeError):  # no home, or none to write to
        return
    os.environ[VARIABLE] = str(own)
    if "jax" in sys.modules:  # it has read its environment
        import jax

        jax.config.update(VARIABLE.lower(), str(own))


def _forget(folder: Path) -> None:
    """Removes what is old: other code, other versions of JAX."""
    for entry in folder.glob("*-cache"):
        with suppress(OSError):  # another process was faster
            if time.time() - entry.stat().st_mtime > _KEPT_S:
                entry.unlink()


def _processor() -> str:
    """What code is compiled for: it may not run on another processor that shares the folder."""
    about = platform.machine() + platform.processor()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        about += "".join(sorted(x for x in lines if x.startswith(("model name", "flags"))))
    return hashlib.sha256(about.encode()).hexdigest()[:16]
