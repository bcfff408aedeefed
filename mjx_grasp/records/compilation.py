"""How long XLA has compiled, so that a figure can stand without it."""

from __future__ import annotations

from typing import Any

import jax.monitoring

_EVENT = "/jax/core/compile/backend_compile_duration"
_total = 0.0


def compile_seconds() -> float:
    """Seconds that this process has compiled since this module was first imported."""
    return _total


def _add(event: str, duration_secs: float, **_: Any) -> None:
    global _total
    if event == _EVENT:
        _total += duration_secs


jax.monitoring.register_event_duration_secs_listener(_add)
