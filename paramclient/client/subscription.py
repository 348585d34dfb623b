"""Asynchronous streams: their base class, their subscribers, and the parameter changes of one component."""

from __future__ import annotations

import weakref
from abc import abstractmethod
from collections.abc import AsyncIterator
from typing import Final, Generic, TypeVar

import anyio

from paramclient.errors import ParamClientError
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.change import Added, Change

__all__ = ["Changes", "ExtChanges", "Subscribers", "Subscription"]

QUEUED_CHANGES_MAX: Final = 100_000
"""Maximum number of changes queued for a consumer, one for each name: more than a table holds, as names may
be removed and others added. Above it, the oldest are dropped."""
QUEUED_EXT_CHANGES_MAX: Final = 10_000
"""The same for extended parameters."""

Item = TypeVar("Item")


class Subscription(AsyncIterator[Item], Generic[Item]):
    """Stream of the items since its creation, one for each `await`. Cancellation loses no item."""

    def __init__(self) -> None:
        self._error: ParamClientError | StopAsyncIteration | None = None
        self._arrived = anyio.Event()

    @abstractmethod
    def push(self, item: Item) -> None:
        """Add an item."""

    @abstractmethod
    def _take(self) -> Item | None:
        """Remove and return the next item; None while the queue is empty."""

    def end(self, error: ParamClientError | None) -> None:
        """End the stream after the queued items: with this error, or with None as at the end of a log."""
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


class Subscribers(Generic[Item]):
    """The streams that receive the items of one source, while something refers to them."""

    def __init__(self) -> None:
        self._streams: weakref.WeakSet[Subscription[Item]] = weakref.WeakSet()
        self._has_ended = False
        self._error: ParamClientError | None = None

    def __len__(self) -> int:
        return len(self._streams)

    def add(self, stream: Subscription[Item]) -> None:
        """Push all further items to a stream. Ends it if none can follow."""
        self._streams.add(stream)
        if self._has_ended:
            stream.end(self._error)

    def discard(self, stream: Subscription[Item]) -> None:
        """Push no further items to a stream."""
        self._streams.discard(stream)

    def push(self, item: Item) -> None:
        """Push an item to all streams."""
        for stream in list(self._streams):
            stream.push(item)

    def end(self, error: ParamClientError | None) -> None:
        """End all streams, and later ones: with this error, or with None at the end of a log."""
        self._has_ended, self._error = True, error
        for stream in list(self._streams):
            stream.end(error)


class Changes(Subscription[Change]):
    """Stream of the parameter changes of one component since its creation; see `Component.changes`.

    A slow consumer receives several changes of one parameter as one. The queue holds at most
    `QUEUED_CHANGES_MAX` changes and then drops the oldest.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: dict[str, Change] = {}

    def push(self, item: Change) -> None:
        """Add a change, or merge it with the queued change of the same parameter."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            old, new = earlier.old, item.new
            if (old is None and new is None) or (old is not None and new is not None and old.same_value(new)):
                return
            item = Change.between(item.name, old, new, item.by, is_added=isinstance(earlier, Added))
        self._waiting[item.name] = item
        if len(self._waiting) > QUEUED_CHANGES_MAX:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()

    def _take(self) -> Change | None:
        return self._waiting.pop(next(iter(self._waiting))) if self._waiting else None


class ExtChanges(Subscription[ExtChange]):
    """Stream of the changes of one component's extended parameters since its creation.

    A slow consumer receives several changes of one parameter as one.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: dict[str, ExtChange] = {}

    def push(self, item: ExtChange) -> None:
        """Add a change, or merge it with the queued change of the same parameter."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            item = ExtChange(item.name, earlier.old, item.new, item.by, earlier.is_added)
            old, new = item.old, item.new
            if (old is None and new is None) or (old is not None and new is not None and old.same_value(new)):
                return
        self._waiting[item.name] = item
        if len(self._waiting) > QUEUED_EXT_CHANGES_MAX:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()

    def _take(self) -> ExtChange | None:
        return self._waiting.pop(next(iter(self._waiting))) if self._waiting else None
