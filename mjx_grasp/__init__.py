"""Steerable and reactive three-finger dexterous grasping on JAX and MuJoCo MJX.

The public names stand in `__init__.pyi`, by what they are about, where type checkers and editors
look for them. Each is loaded when it is first used: importing the package starts no device and
prints nothing.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

_LISTED = ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
_PUBLIC = {
    alias.name: statement.module
    for statement in _LISTED
    if isinstance(statement, ast.ImportFrom) and statement.module
    for alias in statement.names
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    if name == "__version__":
        return _version()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("mjx_grasp")
    except PackageNotFoundError:  # a source tree that is not installed
        return "0.0.0"


def __dir__() -> list[str]:
    return sorted(__all__)
