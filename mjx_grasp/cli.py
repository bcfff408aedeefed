"""What all commands share: an end without a traceback, kept compilations, and a progress bar.

Importing this is cheap, and a command's file imports nothing else at its top: the rest follows
where `starting` watches over it.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

from mjx_grasp.compiled import keep_compiled
from mjx_grasp.errors import MjxGraspError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

_INTERRUPTED = 130


def run_command(command: Callable[[], None], keeps: bool = True, alone: bool = False) -> None:
    """Runs a command; an expected error ends it with its message and status 2, Ctrl-C with 130.

    Args:
        command: What it does.
        keeps: Whether the next one need not compile again what it compiles; a benchmark does.
        alone: Whether it is about one robot, which is planned for on the CPU in a fraction of a
            second, while planning is compiled for minutes for a GPU: this is left alone then,
            unless the environment's own `JAX_PLATFORMS` names it.
    """
    if keeps:
        keep_compiled()
    if alone:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        command()
    except MjxGraspError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except MemoryError as error:
        print(f"error: not enough memory ({error})", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or "interrupted", file=sys.stderr)
        _end_now(_INTERRUPTED)


@contextmanager
def starting() -> Iterator[None]:
    """Ctrl-C ends the process at once, for while a command imports and parses.

    Where libraries are imported a KeyboardInterrupt does not arrive: some lose it, some make an
    error of their own of it. There is nothing to clean up yet.
    """

    def end(*_: object) -> None:
        os.write(2, b"interrupted\n")
        _end_now(_INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # ignored, or somebody else's
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_now(status: int) -> NoReturn:
    """Ends the process without Python's own clean-up.

    What JAX and Warp still compute in threads of theirs would lose its memory to it: now and then
    an interrupted command ended by a segmentation fault.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def counting_progress(console: Console | None, transient: bool = False) -> Progress:
    """A bar with the number done and the time left; shown nowhere if the console is None.

    Args:
        console: Where it is shown.
        transient: Whether it goes when all is done.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=console is None,
        transient=transient,
    )
