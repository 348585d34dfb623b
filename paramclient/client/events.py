"""Events of components as users receive them, and their stream."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, TypeAlias

from paramclient.client.component import Component
from paramclient.client.subscription import Subscription
from paramclient.protocol import events as protocol
from paramclient.protocol.vehicle.peers import Contest

__all__ = [
    "Contested",
    "Event",
    "Events",
    "Found",
    "Heard",
    "Lost",
    "Rebooted",
    "Resynced",
    "Uncontested",
    "told",
]

MOST_EVENTS: Final = 1_000
"""Events that wait for a slow listener; beyond that the oldest ones go."""


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


class Events(Subscription[Event]):
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
