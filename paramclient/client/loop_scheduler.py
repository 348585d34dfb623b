"""The scheduler of an event loop: shares it fairly among the links that are read in it."""

from __future__ import annotations

import math
from typing import Final

import anyio
from anyio.lowlevel import RunVar

from paramclient.protocol.scheduler import Scheduler

__all__ = ["LoopScheduler"]

TURN_MAX: Final = 0.003
"""Seconds of processing received datagrams after which a reader yields to other tasks. The last value of a
list triggers the hash check, which takes 1 ms more, and many lists may end at the same time."""
TURN_DATAGRAMS_MIN: Final = 16
"""Datagrams of one read from which the reader waits for its turn before it processes them."""
BACKLOG_DATAGRAMS_MIN: Final = 64
"""Datagrams of one read that indicate a backlog, as a link returns at most 128."""
BACKLOG_VALIDITY: Final = 0.02
"""Seconds for which a backlog counts after its processing: a reader with more datagrams reads sooner."""
BURST_LISTS_MAX: Final = 24
"""Lists arriving in bursts on all links together, above which no link starts a second one: 24 lists use all
CPU time of the program."""


class LoopScheduler:
    """The scheduler of the links of one event loop; see `of_this_loop`.

    It sets the limits of `paramclient.protocol.scheduler.Scheduler`, the scheduler of the components of one
    link.

    Attributes:
        turn: held by a reader that processes many datagrams. The reader yields to the event loop before it
            releases the lock.
    """

    def __init__(self) -> None:
        self.turn = anyio.Lock(fast_acquire=True)
        self._readers: set[object] = set()
        self._behind: dict[object, float] = {}  # by reader: time until which its backlog counts
        self._bursts: dict[object, int] = {}  # by reader: number of lists that arrive in bursts
        self._awaited: dict[object, int] = {}  # by reader: number of requested lists without a burst yet

    @staticmethod
    def of_this_loop() -> LoopScheduler:
        """Return the instance of the running event loop."""
        try:
            return _scheduler.get()
        except LookupError:
            _scheduler.set(scheduler := LoopScheduler())
            return scheduler

    def register(self, reader: object) -> None:
        """Register a reader."""
        self._readers.add(reader)

    def needs_turns(self, datagrams: int, scheduler: Scheduler) -> bool:
        """Return whether a reader processes its datagrams in turns: they are many, or there are other links.

        Args:
            datagrams: number of datagrams of one read.
            scheduler: the scheduler of the link.
        """
        return datagrams >= TURN_DATAGRAMS_MIN or (len(self._readers) > 1 and scheduler.is_waiting)

    def record_read(self, reader: object, datagrams: int) -> None:
        """Record the number of datagrams of one read. The reader calls `record_processed` after processing
        them."""
        self._behind.pop(reader, None)
        if datagrams >= BACKLOG_DATAGRAMS_MIN:
            self._behind[reader] = math.inf

    def record_processed(self, reader: object, now: float) -> None:
        """Record that the reader has processed its datagrams."""
        if reader in self._behind:
            self._behind[reader] = now + BACKLOG_VALIDITY

    def unregister(self, reader: object) -> None:
        """Remove a reader."""
        self._readers.discard(reader)
        self._behind.pop(reader, None)
        self._bursts.pop(reader, None)
        self._awaited.pop(reader, None)

    def limit_lists(self, reader: object, scheduler: Scheduler, now: float, *, is_behind: bool) -> None:
        """Set the limits of a link's lists that follow from the lists and backlogs of all links.

        Args:
            reader: the reader of the link.
            scheduler: the scheduler of the link.
            now: time of the event loop.
            is_behind: whether the link itself has a backlog.
        """
        admission = scheduler.list_admission
        if is_behind:
            scheduler.lists_max = 1
        else:
            scheduler.lists_max = self.most_lists(
                reader, admission.bursts, now, awaited=admission.awaited(now)
            )
        scheduler.is_crowded = self.is_busy_without(reader)

    def most_lists(self, reader: object, bursts: int, now: float, *, awaited: int = 0) -> float:
        """Return the number of lists that a link may download in parallel, at least 1.

        The result is 1 while any link has a backlog, and infinity while no other link downloads lists.

        Args:
            reader: the reader of the link.
            bursts: number of its lists that arrive in bursts now.
            awaited: number of its requested lists without a burst yet.
            now: time of the event loop.
        """
        self._bursts[reader] = bursts
        self._awaited[reader] = awaited
        others = sum(self._bursts.values()) + sum(self._awaited.values()) - bursts - awaited
        if any(now < until for until in self._behind.values()):
            return 1
        return max(BURST_LISTS_MAX - others, 1) if others else math.inf

    def is_busy_without(self, reader: object) -> bool:
        """Whether lists arrive in bursts on other links. Requested lists without a burst use no CPU time."""
        return any(bursts for each, bursts in self._bursts.items() if each is not reader)


_scheduler: RunVar[LoopScheduler] = RunVar("paramclient event loop scheduler")
