"""Quotas: the maximum number of requests of one kind in progress, of one holder and of all."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Final

import anyio

from paramclient.service.problems import ServiceError

__all__ = [
    "LARGE_GETS_MAX",
    "LARGE_GETS_OF_HOLDER_MAX",
    "LARGE_POSTS_MAX",
    "LARGE_POSTS_OF_HOLDER_MAX",
    "LONG_REQUESTS_MAX",
    "LONG_REQUESTS_OF_HOLDER_MAX",
    "WAITING_REQUESTS_MAX",
    "WAITING_REQUESTS_OF_HOLDER_MAX",
    "Quota",
]

LONG_REQUESTS_MAX: Final = 64
"""Maximum number of long requests in progress: parsing a long body, comparing, planning."""
LONG_REQUESTS_OF_HOLDER_MAX: Final = 8
"""Maximum number of long requests of one holder: they share one thread, and each occupies it for seconds."""
LARGE_GETS_MAX: Final = 64
"""Maximum number of large responses to GET that are created or sent. Each takes up to 2 MB, and its tables
another 2 MB."""
LARGE_GETS_OF_HOLDER_MAX: Final = 8
"""Maximum number of large responses to GET for one holder. Further requests wait."""
LARGE_POSTS_MAX: Final = 128
"""Maximum number of large responses to POST, such as comparisons. `LONG_REQUESTS_MAX` limits how many are
created at once."""
LARGE_POSTS_OF_HOLDER_MAX: Final = 16
"""Maximum number of large responses to POST for one holder. Further requests wait."""

WAITING_REQUESTS_MAX: Final = 128
"""Maximum number of requests in progress that wait for a vehicle, the cache or a comparison: each may be
resumed by one event, such as a datagram. Requests of clients that may write are counted apart from those of
clients that may only read."""
WAITING_REQUESTS_OF_HOLDER_MAX: Final = 64
"""Maximum number of waiting requests of one holder. It is lower while others have many: no holder gets more
slots than remain free."""


class Quota:
    """Counts requests in progress, per holder and in total.

    Args:
        what: name of the counted requests in error messages, in the plural.
        total_max: maximum of all holders together.
        holder_max: maximum of one holder.
        is_fair: whether `hold` gives a holder no more slots than remain free, so that several holders
            together cannot occupy all.
    """

    def __init__(self, what: str, *, total_max: int, holder_max: int, is_fair: bool = False) -> None:
        self._what = what
        self._is_fair = is_fair
        self._total_max = total_max
        self._holder_max = holder_max
        self._slots = anyio.Semaphore(total_max)
        self._holders: dict[str, _HolderSlots] = {}

    def __len__(self) -> int:
        """Return the number of holders that have a slot or wait for one."""
        return len(self._holders)

    @contextmanager
    def hold(self, holder: str) -> Iterator[None]:
        """Occupy a slot of this holder within the block.

        Raises:
            ServiceError: 429, the holder has no free slot, or all slots are occupied.
        """
        with self._slots_of(holder) as own:
            limit = self._holder_max
            used = limit - own.value
            if self._is_fair and used and used >= self._slots.value:
                raise self._too_many(f"{used} {self._what} of yours", used)
            self._take(own, f"{limit} {self._what} of yours", limit)
            try:
                self._take(self._slots, f"{self._total_max} {self._what}", self._total_max)
                try:
                    yield
                finally:
                    self._slots.release()
            finally:
                own.release()

    @asynccontextmanager
    async def wait(self, holder: str) -> AsyncIterator[None]:
        """Occupy a slot of this holder within the block. Wait until one is free, in the order of arrival."""
        with self._slots_of(holder) as own:
            async with own, self._slots:
                yield

    @contextmanager
    def _slots_of(self, holder: str) -> Iterator[anyio.Semaphore]:
        own = self._holders.setdefault(holder, _HolderSlots(self._holder_max))
        own.users += 1
        try:
            yield own.slots
        finally:
            own.users -= 1
            if not own.users:
                del self._holders[holder]

    @classmethod
    def _take(cls, slots: anyio.Semaphore, occupied: str, limit: int) -> None:
        try:
            slots.acquire_nowait()
        except anyio.WouldBlock:
            raise cls._too_many(occupied, limit) from None

    @staticmethod
    def _too_many(occupied: str, limit: int) -> ServiceError:
        what = f"{occupied} are already in progress. Try again later."
        return ServiceError(429, "too-many", what, most=limit)


class _HolderSlots:
    """The slots of one holder.

    Attributes:
        slots: its free slots.
        users: number of requests that have a slot or wait for one.
    """

    def __init__(self, count: int) -> None:
        self.slots = anyio.Semaphore(count)
        self.users = 0
