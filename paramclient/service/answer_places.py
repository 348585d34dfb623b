"""Places for large answers: how many are made and sent at once, of one holder and of all."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

import anyio

__all__ = ["POSTED_MAX", "POSTED_OF_ONE", "READ_MAX", "READ_OF_ONE", "AnswerPlaces"]

READ_MAX: Final = 64
"""Large answers to GET that are made or sent at once. Each takes up to 2 MB, and another 2 MB of tables."""
READ_OF_ONE: Final = 8
"""Those of one holder. Further ones wait."""
POSTED_MAX: Final = 128
"""The same of answers to POST, such as comparisons. `quota.LONG_REQUESTS_MAX` bounds how many are made."""
POSTED_OF_ONE: Final = 16
"""Those of one holder, of which `quota.LONG_REQUESTS_OF_ONE` are made at once."""


class AnswerPlaces:
    """Places that large answers wait for, in the order in which they were asked for.

    Args:
        most: answers of all holders.
        most_of_one: answers of one holder.
    """

    def __init__(self, most: int, most_of_one: int) -> None:
        self._places = anyio.Semaphore(most)
        self._most_of_one = most_of_one
        self._of_holders: dict[str, _Own] = {}

    @asynccontextmanager
    async def take(self, holder: str) -> AsyncIterator[None]:
        """Wait for a place of this holder, and keep it for as long as the block lasts."""
        own = self._of_holders.setdefault(holder, _Own(self._most_of_one))
        own.users += 1
        try:
            async with own.places, self._places:
                yield
        finally:
            own.users -= 1
            if not own.users:
                del self._of_holders[holder]


class _Own:
    """The places of one holder, and how many requests have or want one."""

    def __init__(self, most: int) -> None:
        self.places = anyio.Semaphore(most)
        self.users = 0
