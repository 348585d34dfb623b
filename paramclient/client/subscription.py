"""Streams that a caller iterates over: the base of all, and the changes of one component's parameters."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncIterator
from typing import Final, Generic, TypeVar

import anyio

from paramclient.errors import ParamClientError
from paramclient.protocol.params.change import Change

__all__ = ["Changes", "Subscription"]

MOST_CHANGES: Final = 100_000
"""Changes that wait for a slow listener, one for each name: more than a table can hold, as names may go and
others come. Beyond that the oldest ones go."""

Item = TypeVar("Item")


class Subscription(AsyncIterator[Item], Generic[Item]):
    """What has come since it was made, one item for each `await`. Cancelled, it loses nothing."""

    def __init__(self) -> None:
        self._error: ParamClientError | StopAsyncIteration | None = None
        self._arrived = anyio.Event()

    @abstractmethod
    def push(self, item: Item) -> None:
        """Add an item."""

    @abstractmethod
    def _take(self) -> Item | None:
        """The next item, or None while there is none."""

    def end(self, error: ParamClientError | None) -> None:
        """What waits is still given, then the error is raised; with None it is over, as a log is."""
        self._error = StopAsyncIteration() if error is None else error
        self._arrived.set()

    def __aiter__(self) -> Subscription[Item]:
        return self

    async def __anext__(self) -> Item:
        while (item := self._take()) is None:
            if self._error is not None:
                raise self._error.with_traceback(None)
            if self._arrived.is_set():
                self._arrived = anyio.Event()
            await self._arrived.wait()
        return item


class Changes(Subscription[Change]):
    """The changes of one component's parameters since this object was made; see `Component.changes`."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: dict[str, Change] = {}

    def push(self, item: Change) -> None:
        """Add a change, or join it with one of the same parameter that waits."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            item = Change(item.name, earlier.old, item.new, item.by)
            old, new = item.old, item.new
            if (old is None and new is None) or (old is not None and new is not None and old.same_value(new)):
                return
        self._waiting[item.name] = item
        if len(self._waiting) > MOST_CHANGES:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()

    def _take(self) -> Change | None:
        return self._waiting.pop(next(iter(self._waiting))) if self._waiting else None
