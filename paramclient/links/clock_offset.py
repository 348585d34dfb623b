"""The offset between two clocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

__all__ = ["seconds_ahead"]

CLOCK_READ_TIME_MAX: Final = 20e-6
"""Seconds between two reads of one clock within which the read of the other was not interrupted."""
CLOCK_READS_MAX: Final = 8
"""Reads of both clocks, after which the least interrupted one is used."""


def seconds_ahead(clock: Callable[[], float], other: Callable[[], float]) -> float:
    """Return the seconds by which a clock is ahead of another.

    On a busy machine, the operating system may suspend the process between the reads of the two clocks for
    tens of milliseconds.

    Args:
        clock, other: functions that return the time in seconds.
    """
    shortest, ahead = math.inf, 0.0
    for _ in range(CLOCK_READS_MAX):
        before, at, after = other(), clock(), other()
        if after - before < shortest:
            shortest, ahead = after - before, at - (before + after) / 2
        if shortest <= CLOCK_READ_TIME_MAX:
            break
    return ahead
