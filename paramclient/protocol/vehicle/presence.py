"""Presence of a component: heartbeats, silence, loss. Its reboots are in `reboot_detection`."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.vehicle.reboot_detection import RebootDetection
from paramclient.protocol.wire import Heartbeat

__all__ = ["Presence"]

LOST_AFTER: Final = 5.0
"""Seconds of silence after which a component with heartbeats counts as lost: five missed in a row."""
LOST_INTERVALS: Final = 3.0
"""The heartbeat timeout of a component with a known longer interval, in its own intervals."""
LOST_AFTER_MAX: Final = 60.0
"""The longest heartbeat timeout in seconds: two heartbeats far apart may also be those of a component that
was silent between them."""
HEARTBEAT_INTERVAL_STANDARD: Final = 1.0
"""Seconds between two heartbeats, by the standard."""
GAP_INTERVALS: Final = 2.5
"""Intervals of silence in which a change may have been lost as well: two heartbeats were."""
OVERDUE_INTERVALS: Final = 1.5
"""Intervals after which a heartbeat is late: the link or the event loop delays it."""
DUPLICATE_TIME: Final = 0.5
"""Seconds within which a second heartbeat is a duplicate or a late one."""
LOST_AFTER_HIGH_LATENCY: Final = 20.0
"""The heartbeat timeout in high-latency mode, in seconds: PX4 sends one HIGH_LATENCY2 every 5 s and nothing
else."""


class Presence(RebootDetection):
    """Loss and return of a component, as its own messages show them; and its reboots, see `RebootDetection`.

    A component without heartbeats is never lost: nothing says when its next message is due.

    Attributes:
        beat_at: when the last heartbeat was received; minus infinity before the first.
        base_mode: MAV_MODE_FLAG bits of that heartbeat; None before the first, and while later ones are known
            to be lost.
        gap: seconds of silence after which a change may have been missed.
        received_at: when the last message was received.
        is_lost: whether it has been silent for the heartbeat timeout.
        since: when its first message was received, or the first after a loss.
        is_high_latency: whether HIGH_LATENCY2 was received, and no heartbeat since.
    """

    __slots__ = (
        "_interval",
        "base_mode",
        "beat_at",
        "gap",
        "is_high_latency",
        "is_lost",
        "received_at",
        "since",
    )

    def __init__(self) -> None:
        super().__init__()
        self.received_at = -math.inf
        self.is_lost = False
        self.since = math.inf
        self.is_high_latency = False
        self.gap = GAP_INTERVALS * HEARTBEAT_INTERVAL_STANDARD
        self.beat_at = -math.inf
        self.base_mode: int | None = None
        self._interval = math.inf  # the shortest time between two heartbeats: in longer ones some were lost

    @property
    def heartbeat_timeout(self) -> float:
        """The heartbeat timeout in seconds; infinity before the first heartbeat."""
        if self.is_high_latency:
            return LOST_AFTER_HIGH_LATENCY
        if not self.has_beaten:
            return math.inf
        if self._interval == math.inf:
            return LOST_AFTER
        return min(max(LOST_AFTER, LOST_INTERVALS * self._interval), LOST_AFTER_MAX)

    @property
    def has_beaten(self) -> bool:
        """Whether it ever sent a heartbeat."""
        return self.beat_at > -math.inf

    def is_overdue(self, now: float) -> bool:
        """Return whether a message is overdue though it is not lost: a missing response then says nothing."""
        late = OVERDUE_INTERVALS / GAP_INTERVALS * self.gap
        return self.has_beaten and not self.is_lost and now - self.received_at > late

    def receive(self, now: float) -> float:
        """Process any message and return the seconds of silence before it: infinity for the first one."""
        silence = now - self.received_at
        self.received_at = now
        return silence

    def age(self, seconds: float) -> None:
        """Move all moments back by time that the clock left out."""
        super().age(seconds)
        self.received_at -= seconds
        self.beat_at -= seconds

    def heartbeat(self, message: Heartbeat, now: float) -> bool:
        """Process a heartbeat and return whether it shows a reboot."""
        interval = now - self.beat_at
        if DUPLICATE_TIME <= interval < self._interval:
            self._interval = interval
            self.gap = GAP_INTERVALS * max(interval, HEARTBEAT_INTERVAL_STANDARD)
        self.beat_at = now
        self.base_mode = message.base_mode
        self.is_high_latency = False
        return self._status(message.system_status, now)

    def high_latency(self) -> None:
        """Process HIGH_LATENCY2: further ones arrive every few seconds."""
        self.is_high_latency = True
        self.base_mode = None

    def lost_at(self) -> float:
        """Return when it will be lost without a message; infinity while it is lost."""
        return math.inf if self.is_lost else self.received_at + self.heartbeat_timeout

    def was_silent(self, silence: float) -> bool:
        """Return whether another vehicle may have taken its place in this many seconds."""
        timeout = self.heartbeat_timeout
        return silence >= (timeout if timeout < math.inf else LOST_AFTER)
