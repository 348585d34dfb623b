"""A running list: progress, skipped indices, pace, and the detection of its end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from paramclient.protocol.requests.retry import LIST_REORDER_DEPTH, LIST_SILENCE_MIN, ListAttempts
from paramclient.protocol.scheduler import ListStatistics

__all__ = ["JUMP_MAX", "PACE_VALUES_MIN", "ListStream"]

PACE_VALUES_MIN: Final = 20
"""Values after which the pace of the list is known."""
JUMP_MAX: Final = 40
"""Indices that the list may skip at once. A longer jump counts when the next value continues from there: PX4
pushes changed parameters, with their index, into a running list."""
BURST_GAP_MAX: Final = 0.00025
"""Seconds between two values, below which they count as received together."""
BURSTY_SHARE: Final = 0.5
"""The share of values received together that makes a list one of bursts."""


class ListStream:
    """The observed state of values that arrive by rising index.

    Attributes:
        front: the highest index reached; -1 before the first.
        received_at: when the last value was received, also one that did not advance.
        gap: the mean time between two values in seconds, from `measure`; 0 before.
        is_awaited: whether nothing was received since the request.
        holes: skipped indices not received since: index -> number of advances by then.
    """

    __slots__ = (
        *("_advances", "_began", "_advances_before", "_front_at", "_jump", "_longest", "_bursts"),
        *("front", "gap", "received_at", "holes", "is_awaited"),
    )

    def __init__(self, now: float) -> None:
        self.front = -1
        self.received_at = now
        self.gap = 0.0
        self.is_awaited = True
        self.holes: dict[int, int] = {}
        self._front_at = now
        self._jump = -1  # an index too far ahead to count at once
        self._advances = 0  # how often it advanced
        self._began = (0, now)  # where and when
        self._advances_before = 0  # how often other lists advanced before it
        self._bursts = 0  # values received together with the one before
        self._longest = 0.0  # the longest recent gap

    @property
    def is_at_pace(self) -> bool:
        """Whether enough values were received to know the pace."""
        return self._advances >= PACE_VALUES_MIN

    @property
    def is_bursty(self) -> bool:
        """Whether most of its values are received together."""
        return self._bursts >= BURSTY_SHARE * (self._advances - self._advances_before)

    def rewind(self) -> None:
        """Start at the beginning: the next value belongs to another pass, or to another count."""
        self.front = self._jump = -1
        self.holes.clear()

    def takes(self, index: int, now: float) -> bool:
        """Advance to an index; return False where it is too far ahead to count."""
        if index - self.front > JUMP_MAX and not 0 < index - self._jump <= JUMP_MAX:
            self._jump = index
            return False
        if self.is_awaited:
            self.is_awaited = False
            self._began = (index, now)
            self._advances_before = self._advances
            self._bursts = 0
            self._advances += 1
            self.front = index
            self.received_at = self._front_at = now
        else:
            self.goes_on(index, now)
        return True

    def goes_on(self, index: int, now: float) -> None:
        """Advance to an index that is known to be valid, not the first."""
        self._longest *= 0.99
        gap = now - self.received_at
        if gap > self._longest:
            self._longest = gap
        elif gap < BURST_GAP_MAX:
            self._bursts += 1
        self._advances += 1
        self.front = index
        self.received_at = self._front_at = now

    def pass_over(self, indices: Iterable[int]) -> None:
        """Note skipped indices."""
        self.holes.update(dict.fromkeys(indices, self._advances))

    def lost(self) -> list[int]:
        """Return the holes that count as lost by now, in order."""
        found = []
        for index, seen in self.holes.items():
            if self._advances - seen < LIST_REORDER_DEPTH - 1:
                break
            found.append(index)
        return found

    def quiet_at(self, timeout: float, left: int) -> float:
        """Return when the list is over if nothing more is received.

        Args:
            timeout: seconds after which it is over before its pace is known.
            left: the number of values behind its front.
        """
        if self.is_awaited:
            return self.received_at + max(LIST_SILENCE_MIN, timeout)
        longest = self._longest if self.is_at_pace else None
        return self.received_at + ListAttempts.silence_before_end(timeout, left, longest)

    def ends_at(self, last: int) -> float:
        """Return when the value of this index is expected, at the measured pace."""
        first, since = self._began
        gap = (self._front_at - since) / (self.front - first) if self.front > first else 0.0
        return self._front_at + (last - self.front) * gap

    def seen(self) -> ListStatistics:
        """Return the statistics since the request."""
        if self.is_awaited:
            return ListStatistics(0, 0, 0.0, False)
        advances = self._advances - self._advances_before
        return ListStatistics(advances, self.front - self._began[0] + 1, self._longest, self.is_bursty)

    def measure(self) -> None:
        """Compute the pace; not done for each value."""
        first, since = self._began
        if self.front > first:
            self.gap = (self._front_at - since) / (self.front - first)
