"""Ctrl-C during a training: the first one ends it after the iteration, the second one at once."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from types import FrameType, TracebackType

_NOTICE = "stopping after this iteration; Ctrl-C again stops at once"
_SHOW_CURSOR = "\x1b[?25h"


class InterruptGuard:
    """Within it SIGINT raises nothing: `requested` becomes true, for the loop to look at.

    An iteration donates its input's buffers, so that an exception in the midst of it would leave
    no whole state to save. Python runs its handlers between two bytecodes only and JAX compiles
    and computes outside of them, so the signals are counted by a thread that is woken by each.

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
            self._reader, self._writer = socket.socketpair()
            self._writer.setblocking(False)
            self._previous_fd = signal.set_wakeup_fd(
                self._writer.fileno(), warn_on_full_buffer=False
            )
            signal.signal(signal.SIGINT, self._on_signal)
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._active:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.set_wakeup_fd(self._previous_fd)
            self._writer.close()  # the thread reads the end and returns
            self._thread.join()
            self._reader.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.requested = True

    def _watch(self) -> None:
        count = 0
        while received := self._reader.recv(16):
            for _ in range(received.count(signal.SIGINT)):
                count += 1
                if count == 1:
                    self.requested = True
                    print(_NOTICE, file=sys.stderr, flush=True)
                else:
                    _leave()


def _leave() -> None:
    """Ends the process; nothing that is half done is finished, as with a kill."""
    stream = sys.__stderr__  # the bar's own stand-in for it would draw the bar again
    if stream is not None:
        cursor = _SHOW_CURSOR if stream.isatty() else ""
        print(f"{cursor}\ninterrupted", file=stream, flush=True)
    os._exit(130)
