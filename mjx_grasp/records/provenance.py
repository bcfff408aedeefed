"""The block that every results file carries: what command, code, versions, device and seed."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

# What commands make, tables and pictures: no part of what made them.
_MADE = ("experiments/results", "docs", "README.md", "experiments/README.md")
_RESULTS = tuple(f":(exclude){path}" for path in _MADE)
_DIRTY = "-dirty"
# New files there take part without being named: modules, and what a package ships.
_SOURCES = ("*.py", "mjx_grasp", "assets")
_PACKAGES = ("mjx_grasp", "jax", "mujoco", "mujoco-mjx", "warp-lang", "brax", "numpy", "trimesh")


def provenance(seed: int, command: str | None = None) -> dict[str, Any]:
    """Facts of this run for a results file.

    Args:
        seed: The seed that was used.
        command: The command; by default the one that started this process.
    """
    import jax

    return {
        "command": command or command_line(),
        "git": git_revision(),
        "versions": {"python": platform.python_version()} | versions(),
        "device": device_name(jax.devices()[0]),
        "seed": seed,
    }


def command_line() -> str:
    """The command that started this process, as a user would type it in the repository."""
    main = sys.modules.get("__main__")
    spec = getattr(main, "__spec__", None)
    if spec is not None:
        name = spec.name.removesuffix(".__main__")
        return shlex.join(["python", "-m", name, *sys.argv[1:]])
    script = Path(sys.argv[0])
    root = _root()
    shown = script.resolve().relative_to(root) if script.resolve().is_relative_to(root) else script
    return shlex.join(["python", str(shown), *sys.argv[1:]])


def git_revision() -> str:
    """The checkout's revision, `-dirty` with uncommitted changes; outside one `unknown-` and a
    digest of the modules.

    A repository that the package is merely installed in says nothing of it.
    In a copy it is what `make revision` wrote, also where the copy has a repository of its own that
    does not know that commit. Results do not count as changes, nor do the READMEs that show them:
    the one that is being made lies there while it is made. Nor do new files count that are no part
    of the package or its scripts, such as what commands wrote into the repository.
    """

    def git(*args: str) -> str:
        return subprocess.run(
            ["git", "-C", str(_root()), *args], capture_output=True, text=True, check=True
        ).stdout.strip()

    stamp = _root() / "REVISION"
    copied = stamp.read_text().strip() if stamp.is_file() else None
    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != _root():
            return copied or _unknown()
        revision = git("rev-parse", "HEAD")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", *_RESULTS)
        new = git("ls-files", "--others", "--exclude-standard", "--", *_SOURCES)
    except (OSError, subprocess.CalledProcessError):
        return copied or _unknown()
    try:
        if copied:
            git("cat-file", "-e", copied.removesuffix(_DIRTY) + "^{commit}")
    except subprocess.CalledProcessError:
        return copied or _unknown()
    return revision + (_DIRTY if changed or new else "")


def _unknown() -> str:
    """What stands for a revision where there is none: another one when a module has changed."""
    digest, root = hashlib.sha256(), _root()
    for folder in ("mjx_grasp", "experiments"):
        for path in sorted((root / folder).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"unknown-{digest.hexdigest()[:12]}"


def is_committed(revision: str) -> bool:
    """Whether a revision is all of the code: uncommitted changes are not known by it."""
    return not revision.endswith(_DIRTY)


def file_digests(**paths: Path | None) -> dict[str, str]:
    """SHA-256 of the files that went into a result, by what they are; None stands for no file."""
    return {
        what: hashlib.sha256(path.read_bytes()).hexdigest()
        for what, path in paths.items()
        if path is not None
    }


def versions() -> dict[str, str]:
    """Installed versions of the packages that decide results."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def device_name(device: Any) -> str:
    """A device in words: the GPU's name, or the processor's with its number of cores."""
    if device.platform != "cpu":
        return str(device.device_kind)
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    cores = usable_cores()
    return f"CPU, {cores} core{'s' if cores > 1 else ''} ({model})"


def usable_cores() -> int:
    """CPU cores that this process may use, which a cluster or container may have limited."""
    known = hasattr(os, "sched_getaffinity")  # not on macOS
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


def _root() -> Path:
    return Path(__file__).resolve().parents[2]
