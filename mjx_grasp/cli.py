"""What all commands share: errors without a traceback, and a progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mjx_grasp.errors import MjxGraspError


def run_command(command: Callable[[], None]) -> None:
    """Runs a command; an expected error ends it with its message and exit status 2."""
    try:
        command()
    except MjxGraspError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or "interrupted", file=sys.stderr)
        sys.exit(130)


def counting_progress(console: Console | None, transient: bool = False) -> Progress:
    """A bar with the number done and the time left; shown nowhere if the console is None.

    Args:
        console: Where it is shown.
        transient: Whether it goes when all is done.
    """
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=console is None,
        transient=transient,
    )
