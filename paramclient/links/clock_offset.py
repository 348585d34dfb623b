"""Two clocks, and the difference between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

__all__ = ["seconds_ahead"]

LONGEST_LOOK: Final = 20e-6
"""Seconds between two looks at one clock within which the other one was looked at without an interruption."""
MOST_LOOKS: Final = 8
"""Looks at two clocks, after which the least interrupted one counts."""


def seconds_ahead(clock: Callable[[], float], other: Callable[[], float]) -> float:
    """Return for how many seconds a clock is ahead of another one.

    On a busy machine the system may take the processor away between a look at one clock and a look at the
    other, for tens of milliseconds.

    Args:
        clock, other: what gives the time.
    """
    shortest, ahead = math.inf, 0.0
    for _ in range(MOST_LOOKS):
        before, at, after = other(), clock(), other()
        if after - before < shortest:
            shortest, ahead = after - before, at - (before + after) / 2
        if shortest <= LONGEST_LOOK:
            break
    return ahead
