"""A component's list as it comes: how far it is, what it passed over, its pace, and when it is over."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from paramclient.protocol.scheduler import Seen

__all__ = ["ENOUGH_ADVANCES", "LONGEST_JUMP", "REORDER_DEPTH", "SHORTEST_QUIET", "ListStream"]

REORDER_DEPTH: Final = 3
"""Later values that must have come before a missing one counts as lost, as in TCP's fast retransmit."""
ENOUGH_ADVANCES: Final = 20
"""Values after which the stream's own pace is known."""
QUIET_GAPS: Final = 3.0
"""A stream that pauses for so many of its longest gaps is over; a radio's pauses count among its gaps."""
SHORTEST_QUIET_AT_PACE: Final = 0.06
"""Seconds without a value after which a stream may be over whose last values are due: PX4 sends every 20 ms,
ArduPilot every 10."""
LONGEST_PAUSE: Final = 0.5
"""Seconds without a value after which a stream may be over that is not near its end: ArduPilot's pauses for
up to 0.4 s while it serves reads (measured)."""
TAIL: Final = 24
"""Values behind the last one that came which may all be lost: a list that is silent there is over, however
many of its values are lost."""
SHORTEST_QUIET: Final = 0.25
"""Seconds without a value before the first of them, at the least."""
LONGEST_JUMP: Final = 40
"""Indices that the stream may pass over at once. A longer jump is believed when the next value goes on from
there: PX4 pushes changed parameters, with their index, into a running stream."""
AT_ONCE: Final = 0.00025
MOSTLY: Final = 0.5
"""Seconds between two values that come together, and the share of them that makes a stream one of bursts."""


class ListStream:
    """What is seen of the values that come by rising index.

    Attributes:
        front: the highest index that it has reached; -1 before the first.
        heard_at: when a value came last, also one that did not lead forward.
        gap: the mean time between two values in seconds, as `measure` found it; 0 before.
        is_awaited: whether nothing of it has come since it was asked for.
        holes: what it passed over and has not come since: index -> how often it had gone forward by then.
    """

    __slots__ = (
        *("_advances", "_began", "_came_before", "_front_at", "_jump", "_longest", "_together"),
        *("front", "gap", "heard_at", "holes", "is_awaited"),
    )

    def __init__(self, now: float) -> None:
        self.front = -1
        self.heard_at = now
        self.gap = 0.0
        self.is_awaited = True
        self.holes: dict[int, int] = {}
        self._front_at = now
        self._jump = -1  # an index too far ahead to be believed at once
        self._advances = 0  # how often it went forward
        self._began = (0, now)  # where and when
        self._came_before = 0  # how often others went forward before it
        self._together = 0  # values that came at once with the one before
        self._longest = 0.0  # the longest time between two of late

    @property
    def is_at_pace(self) -> bool:
        """Whether enough has come for its own pace to be known."""
        return self._advances >= ENOUGH_ADVANCES

    @property
    def is_bursty(self) -> bool:
        """Whether most of its values come together."""
        return self._together >= MOSTLY * (self._advances - self._came_before)

    def rewind(self) -> None:
        """What comes next is of another pass, or of another count."""
        self.front = self._jump = -1
        self.holes.clear()

    def takes(self, index: int, now: float) -> bool:
        """Go forward to an index; false where it is too far ahead to be believed."""
        if index - self.front > LONGEST_JUMP and not 0 < index - self._jump <= LONGEST_JUMP:
            self._jump = index
            return False
        if self.is_awaited:
            self.is_awaited = False
            self._began = (index, now)
            self._came_before = self._advances
            self._together = 0
            self._advances += 1
            self.front = index
            self.heard_at = self._front_at = now
        else:
            self.goes_on(index, now)
        return True

    def goes_on(self, index: int, now: float) -> None:
        """Go forward to an index that may be believed, not the first."""
        self._longest *= 0.99
        gap = now - self.heard_at
        if gap > self._longest:
            self._longest = gap
        elif gap < AT_ONCE:
            self._together += 1
        self._advances += 1
        self.front = index
        self.heard_at = self._front_at = now

    def pass_over(self, indices: Iterable[int]) -> None:
        """These in between have not come yet."""
        self.holes.update(dict.fromkeys(indices, self._advances))

    def lost(self) -> list[int]:
        """Holes that count as lost by now, in order."""
        found = []
        for index, seen in self.holes.items():
            if self._advances - seen < REORDER_DEPTH - 1:
                break
            found.append(index)
        return found

    def quiet_at(self, timeout: float, left: int) -> float:
        """When it is over if nothing more comes.

        Args:
            timeout: seconds after which it is over before its pace is known.
            left: how many values it has behind its front.
        """
        if self.is_awaited:
            return self.heard_at + max(SHORTEST_QUIET, timeout)
        if self._advances < ENOUGH_ADVANCES:
            return self.heard_at + max(SHORTEST_QUIET if left <= TAIL else LONGEST_PAUSE, timeout)
        shortest = SHORTEST_QUIET_AT_PACE if left <= TAIL else LONGEST_PAUSE
        return self.heard_at + max(QUIET_GAPS * self._longest, shortest)

    def ends_at(self, last: int) -> float:
        """When the value of this index comes, at the pace of those that have come."""
        first, since = self._began
        gap = (self._front_at - since) / (self.front - first) if self.front > first else 0.0
        return self._front_at + (last - self.front) * gap

    def seen(self) -> Seen:
        """What it has shown since it was asked for."""
        if self.is_awaited:
            return Seen(0, 0, 0.0, False)
        came = self._advances - self._came_before
        return Seen(came, self.front - self._began[0] + 1, self._longest, self.is_bursty)

    def measure(self) -> None:
        """Work out its pace; not done for each value."""
        first, since = self._began
        if self.front > first:
            self.gap = (self._front_at - since) / (self.front - first)
