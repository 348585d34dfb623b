"""What those who listen get: changes of parameters, and what happens to components."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

import anyio

from paramclient.errors import ParamClientError
from paramclient.protocol import events as protocol
from paramclient.protocol.params.change import Change

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.protocol.vehicle.peers import Contest

__all__ = [
    "Changes",
    "Contested",
    "Event",
    "Events",
    "Feed",
    "Found",
    "Heard",
    "Lost",
    "Rebooted",
    "Resynced",
    "Uncontested",
    "told",
]

MOST_CHANGES: Final = 100_000
"""Changes that wait for a slow listener, one for each name: more than a table can hold, as names may go and
others come. Beyond that the oldest ones go."""
MOST_EVENTS: Final = 1_000
"""Events that wait for a slow listener; beyond that the oldest ones go."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Heard:
    """A component was heard for the first time.

    Attributes:
        component: which one.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Lost:
    """A component is not heard any more: five seconds without a word from one that sent heartbeats.

    Attributes:
        component: which one.
        silence: seconds since it was heard last.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Found:
    """A component that was lost is heard again. Who it is and its hash are being asked for.

    Attributes:
        component: which one.
        silence: seconds for which it was not heard.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Rebooted:
    """A vehicle has started again: its clock went back, or its heartbeat says that it is booting.

    For one that was told to (see `Component.reboot`), its silence may have shown it too.

    Attributes:
        component: which one.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Resynced:
    """A table that had fallen behind the vehicle's, or might have, agrees with it again.

    Attributes:
        component: whose table.
        changed: names of what had moved; empty where the hash showed that nothing had.
        hash: the vehicle's hash that confirms the table, or None for one without.
    """

    component: Component
    changed: tuple[str, ...]
    hash: int | None


@dataclass(frozen=True, slots=True)
class Contested:
    """Several vehicles have the address of a component. Its calls raise ContestedAddress until `Uncontested`,
    and nothing of it goes to the cache.

    Attributes:
        component: which one.
        contest: which vehicles, and what tells them apart.
    """

    component: Component
    contest: Contest


@dataclass(frozen=True, slots=True)
class Uncontested:
    """One vehicle alone has the address of a component again. Who it is and its hash are being asked for.

    Attributes:
        component: which one.
    """

    component: Component


Event: TypeAlias = Heard | Lost | Found | Rebooted | Resynced | Contested | Uncontested


def told(event: protocol.Event, component: Component) -> Event | None:
    """An event of the protocol as listeners get it; None for those that are not for them."""
    match event:
        case protocol.ComponentHeard():
            return Heard(component)
        case protocol.ComponentLost():
            return Lost(component, event.silence)
        case protocol.ComponentFound():
            return Found(component, event.silence)
        case protocol.ComponentRebooted():
            return Rebooted(component)
        case protocol.ComponentContested(contest=contest):
            return Contested(component, contest)
        case protocol.ComponentUncontested():
            return Uncontested(component)
        case protocol.TableResynced():
            return Resynced(component, event.changed, event.hash)
        case _:
            return None


class Feed(AsyncIterator[Item], Generic[Item]):
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

    def __aiter__(self) -> Feed[Item]:
        return self

    async def __anext__(self) -> Item:
        while (item := self._take()) is None:
            if self._error is not None:
                raise self._error.with_traceback(None)
            if self._arrived.is_set():
                self._arrived = anyio.Event()
            await self._arrived.wait()
        return item


class Changes(Feed[Change]):
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


class Events(Feed[Event]):
    """What happens to components since this object was made; see `ParamClient.events`."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[Event] = deque(maxlen=MOST_EVENTS)

    def push(self, item: Event) -> None:
        """Add an event."""
        self._waiting.append(item)
        self._arrived.set()

    def _take(self) -> Event | None:
        return self._waiting.popleft() if self._waiting else None
