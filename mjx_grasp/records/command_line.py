"""From a command line to settings; messages name what was typed."""

from __future__ import annotations

import sys
from typing import Any, TypeVar

import tyro

from mjx_grasp.records.settings import named_as_flags

C = TypeVar("C")


def parsed(kind: type[C], description: str | None, **how: Any) -> C:
    """The settings of the command line.

    Args:
        kind: The settings' class.
        description: For the help.
        **how: More of what `tyro.cli` takes.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    typed = None if spec is None else f"python -m {spec.name}"
    with named_as_flags(kind):
        return tyro.cli(kind, prog=typed, description=description, **how)
