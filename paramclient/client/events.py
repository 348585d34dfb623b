"""Public component events, and the stream that delivers them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, TypeAlias

from paramclient.client.component import Component
from paramclient.client.subscription import Subscription
from paramclient.protocol import events as protocol
from paramclient.protocol.vehicle.address_contest import Contest

__all__ = [
    "Contested",
    "Event",
    "Events",
    "Found",
    "Discovered",
    "Lost",
    "Rebooted",
    "Resynced",
    "Uncontested",
    "public_event",
]

EVENTS_MAX: Final = 1_000
"""Maximum number of events queued for a consumer. Above it, the oldest are dropped."""


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
    """A lost component sends again. The client requests its identity and its hash.

    Attributes:
        component: the component.
        silence: seconds without a message.
    """

    component: Component
    silence: float


@dataclass(frozen=True, slots=True)
class Rebooted:
    """A vehicle has rebooted: its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT.

    During `Component.reboot`, silence may indicate the reboot too.

    Attributes:
        component: the component that has rebooted.
    """

    component: Component


@dataclass(frozen=True, slots=True)
class Resynced:
    """A table that was stale, or possibly stale, matches the vehicle again.

    Attributes:
        component: the component of the table.
        changed: names of the parameters that had changed; empty if the hash showed that none had.
        hash: the vehicle's hash that confirms the table; None for a vehicle without a hash.
    """

    component: Component
    changed: tuple[str, ...]
    hash: int | None


@dataclass(frozen=True, slots=True)
class Contested:
    """Several vehicles use the address of a component.

    Until `Uncontested`, its calls raise ContestedAddress, and the cache receives nothing from it.

    Attributes:
        component: the component with the shared address.
        contest: the vehicles, and the differences between them.
    """

    component: Component
    contest: Contest


@dataclass(frozen=True, slots=True)
class Uncontested:
    """Only one vehicle uses the address of a component again. The client requests its identity and its hash.

    Attributes:
        component: the component.
    """

    component: Component


Event: TypeAlias = Discovered | Lost | Found | Rebooted | Resynced | Contested | Uncontested


def public_event(event: protocol.Event, component: Component) -> Event | None:
    """Return the public event for a protocol event; None for internal events."""
    match event:
        case protocol.ComponentDiscovered():
            return Discovered(component)
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
    """Stream of the component events since its creation; see `ParamClient.events`.

    It queues at most `EVENTS_MAX` events and then drops the oldest.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[Event] = deque(maxlen=EVENTS_MAX)

    def push(self, item: Event) -> None:
        """Add an event."""
        self._waiting.append(item)
        self._arrived.set()

    def _take(self) -> Event | None:
        return self._waiting.popleft() if self._waiting else None
