"""The links that are read in one event loop: they share its time."""

from __future__ import annotations

from typing import Final

from anyio.lowlevel import RunVar

__all__ = ["Crowd"]

LONGEST_TURN: Final = 0.005
"""Seconds of what came at once after which other tasks get their turn: with the last value of a list its hash
is proven, which takes a millisecond, and many lists may end at once. All links on which much comes share it,
as each of them has its turn before the event loop has come round."""
SHORTEST_TURN: Final = 0.00025
"""Seconds of it at the least: some tens of values, below which the way round itself costs more."""
SOME: Final = 16
MANY: Final = 128
"""Datagrams read at once that take a turn, and that show that there are more: a link gives up to 256."""
LASTING: Final = 0.02
"""Seconds for which that says something of a link: who has more to read, reads again before that."""


class Crowd:
    """What the readers of one event loop know of each other; see `of_this_loop`."""

    def __init__(self) -> None:
        self._read: dict[object, tuple[float, int]] = {}  # by reader: when, and how many datagrams at once

    @staticmethod
    def of_this_loop() -> Crowd:
        """That of the event loop that runs."""
        try:
            return _crowd.get()
        except LookupError:
            _crowd.set(crowd := Crowd())
            return crowd

    def came(self, reader: object, datagrams: int, now: float) -> None:
        """A reader has read so many at once, or has not done with them yet."""
        self._read[reader] = now, datagrams

    def left(self, reader: object) -> None:
        """A reader has ended."""
        self._read.pop(reader, None)

    def turn(self, now: float) -> float:
        """Seconds after which a reader gives way to other tasks."""
        return max(LONGEST_TURN / max(self._number(SOME, now), 1), SHORTEST_TURN)

    def is_behind(self, now: float) -> bool:
        """Whether more has come on any link than was read."""
        return self._number(MANY, now) > 0

    def _number(self, least: int, now: float) -> int:
        return sum(datagrams >= least and now < at + LASTING for at, datagrams in self._read.values())


_crowd: RunVar[Crowd] = RunVar("paramclient crowd")
