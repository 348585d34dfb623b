"""How much of one kind of work may be under way at once: of one holder, and of all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from paramclient.service.problems import ServiceError

__all__ = ["LONG_REQUESTS_MAX", "LONG_REQUESTS_OF_ONE", "Quota"]

LONG_REQUESTS_MAX: Final = 64
"""Requests of all holders that parse a long body, compare or plan, and are not answered yet."""
LONG_REQUESTS_OF_ONE: Final = 8
"""Those of one holder: they share one thread, and each may keep it for seconds."""


class Quota:
    """Counts what is under way.

    Args:
        what: for messages, in the plural.
        most: of all holders together.
        most_of_one: of one holder.
    """

    def __init__(self, what: str, *, most: int, most_of_one: int) -> None:
        self._what = what
        self._most = most
        self._most_of_one = most_of_one
        self._held: Counter[str] = Counter()

    @contextmanager
    def hold(self, holder: str) -> Iterator[None]:
        """Count one more of this holder, for as long as the block lasts.

        Raises:
            ServiceError: 429, the holder has as many as it may, or all together have.
        """
        self.check(holder, self._held)
        self._held[holder] += 1
        try:
            yield
        finally:
            self._held[holder] -= 1
            if not self._held[holder]:
                del self._held[holder]

    def check(self, holder: str, held: Counter[str]) -> None:
        """See that there may be one more of this holder, where so many are under way of each.

        Raises:
            ServiceError: 429, there may not.
        """
        if held[holder] >= self._most_of_one:
            told = f"{self._most_of_one} {self._what} of yours are under way already."
            raise ServiceError(429, "too-many", told, most=self._most_of_one)
        if held.total() >= self._most:
            told = f"{self._most} {self._what} are under way already."
            raise ServiceError(429, "too-many", told, most=self._most)
