"""Whether time has passed in which nothing was done here: the computer slept, or the process was stopped."""

from __future__ import annotations

import math
import sys
import time
from typing import Final

__all__ = ["Standstill", "time_asleep"]

STANDSTILL: Final = 2.0
"""Seconds from which an absence of ours counts. Below, no more than a heartbeat or two was missed, and what
is late by so little is asked for once more at most."""


class Standstill:
    """Notices that nobody was at work here.

    A suspended computer shows it in one of two ways. Where the loop's clock goes on meanwhile (Windows), who
    wanted to be woken is late by all of it, as in a process that was stopped or held up. Where it stands
    still (Linux, macOS), another clock tells for how long that was.
    """

    def __init__(self) -> None:
        self._due = math.inf
        self._asleep = time_asleep()

    def expect(self, due: float) -> None:
        """Work is to go on at this time at the latest; infinity while that is open."""
        self._due = due

    def unseen(self, now: float) -> float | None:
        """Seconds that the clock has left out since it was asked last; None when nobody was away for long."""
        late = now - self._due
        asleep = time_asleep()
        unseen = asleep - self._asleep
        self._asleep = asleep
        if unseen < STANDSTILL and late < STANDSTILL:
            return None
        self._due = math.inf
        return max(unseen, 0.0)


def time_asleep() -> float:
    """Seconds for which this computer has slept, as far as the event loop's clock leaves them out."""
    if sys.platform == "linux":
        asleep = time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)
    elif sys.platform == "darwin":  # its CLOCK_MONOTONIC goes on in sleep, see clock_gettime(3)
        asleep = time.clock_gettime(time.CLOCK_MONOTONIC) - time.clock_gettime(time.CLOCK_UPTIME_RAW)
    else:
        asleep = 0.0
    return asleep
