"""Events of the components of a client, and their stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from paramclient.client.streams import Stream

if TYPE_CHECKING:
    from paramclient.client.component import Component

__all__ = ["Discovered", "Event", "Events", "Found", "Lost", "Rebooted", "Resynced"]

EVENTS_MAX: Final = 1_000
"""Queued events for a consumer, at most."""


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
        hash: PX4's hash or ArduPilot's checksum that confirms the table; None without one.
    """

    component: Component
    changed: tuple[str, ...]
    hash: int | None


Event: TypeAlias = Discovered | Lost | Found | Rebooted | Resynced


class Events(Stream[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`."""

    most = EVENTS_MAX
