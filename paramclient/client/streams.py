"""Asynchronous streams: of the parameter changes of a component, and of the events of all components."""

from __future__ import annotations

import weakref
from abc import abstractmethod
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

import anyio

from paramclient.errors import ParamClientError
from paramclient.protocol.events import Change

if TYPE_CHECKING:
    from paramclient.client.component import Component

__all__ = [
    "Changes",
    "Discovered",
    "Event",
    "Events",
    "Found",
    "Lost",
    "Rebooted",
    "Resynced",
    "Stream",
    "Subscribers",
]


CHANGES_MAX: Final = 100_000
"""Queued changes for a consumer, one for each name, at most: more than a table holds. Above it, the oldest
are dropped."""

EVENTS_MAX: Final = 1_000
"""Queued events for a consumer, at most. Above it, the oldest are dropped."""

Item = TypeVar("Item")


class Stream(AsyncIterator[Item], Generic[Item]):
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

    def __aiter__(self) -> Stream[Item]:
        return self

    async def __anext__(self) -> Item:
        while (item := self._take()) is None:
            if self._error is not None:
                raise self._error.with_traceback(None)
            if self._arrived.is_set():
                self._arrived = anyio.Event()
            await self._arrived.wait()
        return item


class Changes(Stream[Change]):
    """Stream of the changes since its creation; see `Component.changes`.

    A slow consumer receives several changes of one parameter as one.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: dict[str, Change] = {}

    def push(self, item: Change) -> None:
        """Add a change, or merge it with the queued change of the same parameter."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            item = _merged(earlier, item)
            if item.old is None and item.new is None:
                return
            if item.old is not None and item.new is not None and item.old.same_value(item.new):
                return
        self._waiting[item.name] = item
        if len(self._waiting) > CHANGES_MAX:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()

    def _take(self) -> Change | None:
        return self._waiting.pop(next(iter(self._waiting))) if self._waiting else None


@dataclass(frozen=True, slots=True)
class Discovered:
    """The first message of a component has arrived.

    Attributes:
        component: the new component.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Lost:
    """A component is lost: it has sent heartbeats before, and no message for the heartbeat timeout: 5 s,
    longer for slow heartbeats and in high-latency mode.

    Attributes:
        component: the lost component.
        silence: seconds since its last message.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Found:
    """A lost component sends again. The client requests its identity and checks its table.

    Attributes:
        component: the component.
        silence: seconds without a message.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Rebooted:
    """A vehicle has rebooted: its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT.

    Attributes:
        component: the component that has rebooted.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Resynced:
    """A table that was stale, or possibly stale, matches the vehicle again.

    Attributes:
        component: the component of the table.
        changed: names of the parameters that had changed.
        hash: the vehicle's hash that confirms the table; None for a vehicle without a hash.
    """

    component: Component
    changed: tuple[str, ...]
    hash: int | None


Event: TypeAlias = Discovered | Lost | Found | Rebooted | Resynced


class Events(Stream[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[Event] = deque(maxlen=EVENTS_MAX)

    def push(self, item: Event) -> None:
        """Add an event."""
        self._waiting.append(item)
        self._arrived.set()

    def _take(self) -> Event | None:
        return self._waiting.popleft() if self._waiting else None


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


def _merged(earlier: Change, later: Change) -> Change:
    kind = later.kind
    if later.new is not None:
        kind = earlier.kind if earlier.old is None else "changed"
    return replace(later, old=earlier.old, kind=kind)
