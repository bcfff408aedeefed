"""What all commands share: errors of the user's making are one line, not a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable

from mjx_grasp.errors import MjxGraspError


def run_command(command: Callable[[], None]) -> None:
    """Runs a command; an expected error ends it with its message and exit status 2."""
    try:
        command()
    except MjxGraspError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
