"""Detection of suspend/resume of the computer, and of a stopped process."""

from __future__ import annotations

import math
import sys
import time
from typing import Final

__all__ = ["SuspendDetector", "time_asleep"]

SUSPEND_MIN: Final = 2.0
"""Seconds of suspension from which it is reported. A shorter one misses at most two heartbeats, and causes at
most one retry of a request."""


class SuspendDetector:
    """Detects that the event loop did not run.

    There are two indications. If the clock of the event loop runs during suspend (Windows), a timer fires
    late by the whole duration, as it does in a stopped process. If that clock stops during suspend (Linux,
    macOS), the difference to a second clock gives the duration.
    """

    def __init__(self) -> None:
        self._due = math.inf
        self._asleep = time_asleep()

    def expect(self, due: float) -> None:
        """Set the time at which the event loop is due to continue; infinity if there is no deadline."""
        self._due = due

    def unseen(self, now: float) -> float | None:
        """Return the seconds that the clock of the event loop left out since the last call.

        None if there was no suspension of `SUSPEND_MIN` or longer. 0.0 for a suspension during which the
        clock went on.

        Args:
            now: time of the event loop.
        """
        late = now - self._due
        asleep = time_asleep()
        unseen = asleep - self._asleep
        self._asleep = asleep
        if unseen < SUSPEND_MIN and late < SUSPEND_MIN:
            return None
        self._due = math.inf
        return max(unseen, 0.0)


def time_asleep() -> float:
    """Return the seconds of suspend since boot that the clock of the event loop leaves out."""
    if sys.platform == "linux":
        asleep = time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)
    elif sys.platform == "darwin":  # its CLOCK_MONOTONIC runs during suspend, see clock_gettime(3)
        asleep = time.clock_gettime(time.CLOCK_MONOTONIC) - time.clock_gettime(time.CLOCK_UPTIME_RAW)
    else:
        asleep = 0.0
    return asleep
