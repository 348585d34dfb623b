"""A list that comes although we have not asked for it: another station has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from paramclient.protocol.params.list_stream import LONGEST_JUMP, LONGEST_PAUSE, QUIET_GAPS
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.wire import NO_INDEX, ParamValue

__all__ = ["Following"]

ENOUGH_TO_FOLLOW: Final = 10
"""Values by rising index that are a list: PX4 pushes up to a few changed parameters with their index, and
another station may read some one by one."""
FEWEST_HEARD: Final = 0.5
"""The share of the indices passed that a list brings, at the least. When another station sets many parameters
at once, PX4 pushes these by rising index too: 200 of 905."""


class Following:
    """Follows the values that come while no list of ours does."""

    __slots__ = ("_began_at", "_count", "_front", "_heard_at", "_longest", "_names")

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """What has come belongs to no list that still runs."""
        self._names: dict[int, str] = {}
        self._count = 0
        self._front = -1
        self._began_at = self._heard_at = -math.inf
        self._longest = 0.0

    def heard(self, message: ParamValue, now: float) -> None:
        """A PARAM_VALUE has come."""
        name, _, _, count, index = message
        if index >= count or count == NO_INDEX:
            return
        gap = now - self._heard_at
        is_next = 0 < index - self._front <= LONGEST_JUMP and count == self._count
        if not is_next or gap > self._quiet:
            if index == self._front and count == self._count:
                return  # a copy
            self.forget()
            self._count = count
            self._began_at = now
        elif gap > self._longest:
            self._longest = gap
        self._names[index] = name
        self._front = index
        self._heard_at = now

    def is_running(self, now: float) -> bool:
        """Whether a list comes, and has not come to its end."""
        came = len(self._names)
        if came < ENOUGH_TO_FOLLOW or self._front >= self._count - 1:
            return False
        passed = self._front - next(iter(self._names)) + 1
        is_list = came >= FEWEST_HEARD * passed
        return is_list and now - self._heard_at <= self._quiet

    def hand_over(self, reads: Reads) -> tuple[Mapping[int, str], int]:
        """What it has brought so far, by index, and the param_count; the reads learn its pace and its end."""
        gap = reads.pace.gap = (self._heard_at - self._began_at) / max(len(self._names) - 1, 1)
        reads.list_until = self._heard_at + (self._count - self._front) * gap + self._quiet
        return self._names, self._count

    @property
    def _quiet(self) -> float:
        """Seconds without a value after which it is over."""
        return max(QUIET_GAPS * self._longest, LONGEST_PAUSE)
