"""A loop in real time, or slower where its ticks take longer."""

from __future__ import annotations

import time
from collections.abc import Callable


class Pace:
    """Lets ticks begin no sooner than a period after each other; what is late stays late.

    Args:
        period: Between ticks [s].
        clock: The time [s].
        sleep: Waits so long [s].
    """

    def __init__(
        self,
        period: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._period, self._clock, self._sleep = period, clock, sleep
        self._due = self._before = clock()
        self.rate = 1.0
        """simulated time per real time, over about the last second [-]"""

    def wait(self) -> None:
        """Returns when the next tick may begin."""
        now = self._clock()
        if now < self._due:
            self._sleep(self._due - now)
            now = self._clock()
        self._due = max(self._due, now) + self._period
        took, self._before = max(now - self._before, self._period), now
        self.rate += self._period * (self._period / took - self.rate)
