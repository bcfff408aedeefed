"""Ctrl-C during a training: the first one ends it after the iteration, the second one at once."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType

_NOTICE = "stopping after this iteration; Ctrl-C again stops without keeping it"


class InterruptGuard:
    """Within it the first SIGINT raises nothing: `requested` becomes true, for the loop to look at.

    An iteration donates its input's buffers, so that an exception in the midst of it would leave
    no whole state to save. The second one raises `KeyboardInterrupt`, as Python does it: once the
    compiled code that is running has returned.

    Outside the main thread, and where SIGINT is ignored or handled by others, it does nothing.
    """

    def __init__(self) -> None:
        self.requested = False
        self._active = False

    def __enter__(self) -> InterruptGuard:
        self._active = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if self._active:
            signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        if self._active:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print(_NOTICE, file=sys.stderr, flush=True)
