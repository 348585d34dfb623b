"""A list that another station has requested."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from paramclient.protocol.params.list_stream import JUMP_MAX
from paramclient.protocol.params.reads import Reads
from paramclient.protocol.requests.retry import LIST_END_GAPS, STREAM_PAUSE_MAX
from paramclient.protocol.wire import NO_INDEX, ParamValue

__all__ = ["ForeignList"]

LIST_VALUES_MIN: Final = 10
"""Values by rising index that make a list: PX4 pushes up to a few changed parameters with their index, and
another station may read some one by one."""
RECEIVED_SHARE_MIN: Final = 0.5
"""The share of the passed indices that a list brings, at least. When another station sets many parameters at
once, PX4 pushes these by rising index too: 200 of 905."""


class ForeignList:
    """Follows received values while no list of ours runs."""

    __slots__ = ("_began_at", "_count", "_front", "_longest", "_names", "_received_at")

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget the values so far: they belong to no running list."""
        self._names: dict[int, str] = {}
        self._count = 0
        self._front = -1
        self._began_at = self._received_at = -math.inf
        self._longest = 0.0

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE."""
        name, _, _, count, index = message
        if index >= count or count == NO_INDEX:
            return
        gap = now - self._received_at
        is_next = 0 < index - self._front <= JUMP_MAX and count == self._count
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
        self._received_at = now

    def is_running(self, now: float) -> bool:
        """Return whether a list is running."""
        received = len(self._names)
        if received < LIST_VALUES_MIN or self._front >= self._count - 1:
            return False
        passed = self._front - next(iter(self._names)) + 1
        is_list = received >= RECEIVED_SHARE_MIN * passed
        return is_list and now - self._received_at <= self._quiet

    def hand_over(self, reads: Reads) -> tuple[Mapping[int, str], int]:
        """Return its values by index and the param_count; the reads learn its pace and its end."""
        gap = reads.pace.gap = (self._received_at - self._began_at) / max(len(self._names) - 1, 1)
        reads.list_until = self._received_at + (self._count - self._front) * gap + self._quiet
        return self._names, self._count

    @property
    def _quiet(self) -> float:
        """Seconds without a value after which it is over."""
        return max(LIST_END_GAPS * self._longest, STREAM_PAUSE_MAX)
