"""Events of the components of a client, and their stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from paramclient.client.streams import Stream

if TYPE_CHECKING:
    from paramclient.client.component import Component

EVENTS_MAX: Final = 1_000
"""Queued events for a consumer, at most."""


@dataclass(frozen=True, slots=True)
class Event:
    """What has happened to a component.

    Attributes:
        component: the component.
        kind: "discovered": its first message has arrived. "lost": it has sent heartbeats before, and no
            message for the heartbeat timeout: 5 s, longer for slow heartbeats and in high-latency mode.
            "found": a lost component sends again; the client requests its identity and checks its table.
            "rebooted": its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT. "resynced": a
            table that was stale, or possibly stale, matches the vehicle again.
        silence: seconds without a message, of "lost" and "found"; None of others.
        changed: of "resynced", the names of the parameters that had changed.
        hash: of "resynced", PX4's hash or ArduPilot's checksum that confirms the table; None without one.
    """

    component: Component
    kind: Literal["discovered", "lost", "found", "rebooted", "resynced"]
    silence: float | None = None
    changed: tuple[str, ...] = ()
    hash: int | None = None


class Events(Stream[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`."""

    most = EVENTS_MAX
