"""The facts about one component that its machines share, and the way to send to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from paramclient.protocol.requests.retry import RetryPolicy
from paramclient.protocol.requests.round_trip import RoundTrip
from paramclient.protocol.stats.trace import Trace, discard
from paramclient.protocol.wire import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4, Message

__all__ = ["Context"]

OWN_ADDRESS: Final = (255, 190)
"""System and component of a usual ground station: MAV_COMP_ID_MISSIONPLANNER of system 255."""


@dataclass(slots=True, eq=False)
class Context:
    """The facts about one component that several of its machines need, and the way to send to it.

    One machine learns a fact and sets it when it changes; the others read it.

    Attributes:
        target: system and component.
        send: takes each message for the component, in order.
        own: system and component that requests are sent as.
        retry: when its requests count as lost, and when they are given up.
        trace: takes a line for each step.
        may_send: whether requests may be sent to it; false for listen-only links.
        reschedule: called when a deadline may have changed although no message was received or sent.
        autopilot: MAV_AUTOPILOT of its heartbeat, None before the first one. Set by `Identification`.
        is_identifying: whether AUTOPILOT_VERSION is requested. Set by `Identification`.
        may_be_another: whether another vehicle may have taken its place since the identification, or has, and
            is being identified. Set by `Identification`.
        serves_file: whether it serves its table as a file over MAVFTP, as far as known. Set by
            `Identification`.
        adds_defaults: whether it is known to serve that file with defaults. Set by `Identification`.
        is_requesting_message: whether a message is requested, so that an acknowledgement is awaited. Set by
            `MessageRequests`.
        has_hash: whether it has a `_HASH_CHECK`; None while unknown. Set by `Sync`.
        is_writing: whether a write is in progress. Set by `Writes`.
        is_fetching: whether a fetch is in progress. Set by `Fetches`.
    """

    target: tuple[int, int]
    send: Callable[[Message], None]
    own: tuple[int, int] = OWN_ADDRESS
    retry: RetryPolicy = field(default_factory=RetryPolicy)
    trace: Trace = discard
    may_send: bool = True
    reschedule: Callable[[], None] = lambda: None
    autopilot: int | None = None
    is_identifying: bool = False
    may_be_another: bool = False
    serves_file: bool = False
    adds_defaults: bool = False
    is_requesting_message: bool = False
    has_hash: bool | None = None
    is_writing: bool = False
    is_fetching: bool = False

    @property
    def round_trip(self) -> RoundTrip:
        """The measured round-trip time and packet loss."""
        return self.retry.round_trip

    @property
    def is_px4(self) -> bool:
        """Whether the heartbeat names PX4."""
        return self.autopilot == MAV_AUTOPILOT_PX4

    @property
    def is_ardupilot(self) -> bool:
        """Whether the heartbeat names ArduPilot."""
        return self.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA

    @property
    def is_doubted(self) -> bool:
        """Whether another vehicle may have taken its place, and its identity is awaited."""
        return self.may_be_another and self.is_identifying

    @property
    def expects_hash(self) -> bool:
        """Whether it has a hash, as far as known: every PX4 has one until it responds otherwise."""
        return self.is_px4 if self.has_hash is None else self.has_hash
