"""Asynchronous streams of items, and of the parameter changes of one component."""

from __future__ import annotations

import weakref
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import ClassVar, Generic, Self, TypeVar

import anyio

from paramclient.errors import ParamClientError
from paramclient.protocol.table import Change

Item = TypeVar("Item")


class Stream(AsyncIterator[Item], Generic[Item]):
    """Stream of the items since its creation, one for each `await`. Cancellation loses no item.

    Attributes:
        most: queued items for a slow consumer. Above it, the oldest are dropped.
    """

    most: ClassVar[int]

    def __init__(self) -> None:
        self._waiting: dict[object, Item] = {}
        self._error: ParamClientError | StopAsyncIteration | None = None
        self._arrived = anyio.Event()

    def push(self, item: Item) -> None:
        """Add an item."""
        self._queue(object(), item)

    def end(self, error: ParamClientError | None) -> None:
        """End the stream after the queued items: with this error, or with None as at the end of a log."""
        self._error = StopAsyncIteration() if error is None else error
        self._arrived.set()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Item:
        while not self._waiting:
            if self._error is not None:
                raise self._error.with_traceback(None)
            if self._arrived.is_set():
                self._arrived = anyio.Event()
            await self._arrived.wait()
        return self._waiting.pop(next(iter(self._waiting)))

    def _queue(self, key: object, item: Item) -> None:
        self._waiting[key] = item
        if len(self._waiting) > self.most:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()


class Changes(Stream[Change]):
    """Stream of the changes since its creation; see `Component.changes`.

    A slow consumer receives several changes of one parameter as one.
    """

    most = 100_000  # more than a table has names

    def push(self, item: Change) -> None:
        """Add a change, or merge it with the queued change of the same parameter."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            kind = item.kind
            if item.new is not None:
                kind = earlier.kind if earlier.old is None else "changed"
            item = replace(item, old=earlier.old, kind=kind)
            if item.old is None and item.new is None:
                return
            if item.old is not None and item.new is not None and item.old.same_value(item.new):
                return
        self._queue(item.name, item)


class Subscribers(Generic[Item]):
    """The streams that are still referenced."""

    def __init__(self) -> None:
        self._streams: weakref.WeakSet[Stream[Item]] = weakref.WeakSet()
        self._end: tuple[ParamClientError | None] | None = None

    def add(self, stream: Stream[Item]) -> None:
        """Push all further items to this stream; end it at once if there are none any more."""
        self._streams.add(stream)
        if self._end is not None:
            stream.end(*self._end)

    def push(self, item: Item) -> None:
        """Push an item to all streams."""
        for stream in list(self._streams):
            stream.push(item)

    def end(self, error: ParamClientError | None) -> None:
        """End all streams, also those that are added later."""
        self._end = (error,)
        for stream in list(self._streams):
            stream.end(error)
