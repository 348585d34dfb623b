"""The links that are read in one event loop: they share its time."""

from __future__ import annotations

import math
from typing import Final

import anyio
from anyio.lowlevel import RunVar

__all__ = ["Crowd"]

LONGEST_TURN: Final = 0.003
"""Seconds of what came at once after which other tasks get their turn. With the last value of a list its hash
is proven, which takes a millisecond more, and many lists may end at once."""
SOME: Final = 16
MANY: Final = 64
"""Datagrams read at once for which a link waits for its turn, and that show that there are more: a link gives
up to 128."""
LASTING: Final = 0.02
"""Seconds for which that says something of a link when it has done with them: who has more, reads again."""
ENOUGH_LISTS: Final = 24
"""Lists in bursts on all links together beside which no link begins a second one: so many take all the time
that the program has."""
LOOK_AGAIN: Final = 0.01
"""Seconds after which a link that waits for the others looks at them again."""


class Crowd:
    """What the readers of one event loop know of each other; see `of_this_loop`.

    Attributes:
        turn: who takes many datagrams holds it, and lets the event loop come round before the next one does.
    """

    def __init__(self) -> None:
        self.turn = anyio.Lock(fast_acquire=True)
        self._readers: set[object] = set()
        self._behind: dict[object, float] = {}  # by reader: until when there is more to be read
        self._bursts: dict[object, int] = {}  # by reader: its lists that come in bursts
        self._awaited: dict[object, int] = {}  # by reader: its lists that may do so soon

    @staticmethod
    def of_this_loop() -> Crowd:
        """That of the event loop that runs."""
        try:
            return _crowd.get()
        except LookupError:
            _crowd.set(crowd := Crowd())
            return crowd

    def joined(self, reader: object) -> None:
        """A reader has begun."""
        self._readers.add(reader)

    @property
    def has_others(self) -> bool:
        """Whether there is more than one."""
        return len(self._readers) > 1

    def came(self, reader: object, datagrams: int) -> None:
        """A reader has read so many at once, and will say when it has taken them."""
        self._behind.pop(reader, None)
        if datagrams >= MANY:
            self._behind[reader] = math.inf

    def taken(self, reader: object, now: float) -> None:
        """It has."""
        if reader in self._behind:
            self._behind[reader] = now + LASTING

    def left(self, reader: object) -> None:
        """A reader has ended."""
        self._readers.discard(reader)
        self._behind.pop(reader, None)
        self._bursts.pop(reader, None)
        self._awaited.pop(reader, None)

    def most_lists(self, reader: object, bursts: int, now: float, *, awaited: int = 0) -> float:
        """How many lists a link may have running beside each other: one in any case.

        No more, where more has come on any link than was read. A link that is alone has its own measure.

        Args:
            reader: of the link.
            bursts: how many of its lists come in bursts now.
            awaited: how many may do so soon.
        """
        self._bursts[reader] = bursts
        self._awaited[reader] = awaited
        others = sum(self._bursts.values()) + sum(self._awaited.values()) - bursts - awaited
        if any(now < until for until in self._behind.values()):
            return 1
        return max(ENOUGH_LISTS - others, 1) if others else math.inf

    def is_busy_without(self, reader: object) -> bool:
        """Whether lists come in bursts on other links: one that is only awaited takes no time of anybody."""
        return any(bursts for each, bursts in self._bursts.items() if each is not reader)


_crowd: RunVar[Crowd] = RunVar("paramclient crowd")
