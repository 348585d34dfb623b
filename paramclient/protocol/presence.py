"""Whether a component is there: its heartbeats, its silence, its reboots."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.wire import MAV_STATE_BOOT, Heartbeat, SystemTime

__all__ = ["Presence"]

LOST_AFTER: Final = 5.0
"""Seconds without a word after which a component that sent heartbeats counts as lost: five in a row."""
BEATS_TO_MISS: Final = 3.0
"""For one that is known to send fewer heartbeats than one a second: so many of its own intervals."""
ENOUGH_BEATS: Final = 4
"""Heartbeats after which that interval is known."""
LOST_AFTER_HIGH_LATENCY: Final = 20.0
"""The same in high-latency mode, where PX4 sends one HIGH_LATENCY2 every 5 seconds and nothing else."""
OUT_OF_ORDER: Final = 2_000
"""Milliseconds by which SYSTEM_TIME may go back because a link brought two of them in the wrong order."""
WRAP: Final = 1 << 32
"""Where time_boot_ms begins anew, after 49 days."""


class Presence:
    """What a component's own messages tell of its coming, going and starting again.

    A component that never sent a heartbeat is never lost: nothing says when it should have been heard.

    Attributes:
        heard_at: when anything came from it last.
        is_lost: whether it has been silent for too long since.
        is_high_latency: whether it said so: HIGH_LATENCY2 came, and no heartbeat since.
    """

    __slots__ = (
        "_beat_at",
        "_beats",
        "_boot_ms",
        "_interval",
        "_state",
        "heard_at",
        "is_high_latency",
        "is_lost",
    )

    def __init__(self) -> None:
        self.heard_at = -math.inf
        self.is_lost = False
        self.is_high_latency = False
        self._beat_at = -math.inf
        self._beats = 0
        self._interval = math.inf  # the shortest time between two heartbeats: the others were lost
        self._state: int | None = None
        self._boot_ms: int | None = None

    @property
    def patience(self) -> float:
        """Seconds of silence after which it is lost; infinity as long as nothing can be expected of it."""
        if self.is_high_latency:
            return LOST_AFTER_HIGH_LATENCY
        if not self._beats:
            return math.inf
        if self._beats < ENOUGH_BEATS:
            return LOST_AFTER
        return max(LOST_AFTER, BEATS_TO_MISS * self._interval)

    def heard(self, now: float) -> float:
        """Anything has come. Gives the seconds of silence before it: infinity for the first word."""
        silence = now - self.heard_at
        self.heard_at = now
        return silence

    def heartbeat(self, message: Heartbeat, now: float) -> bool:
        """Take a heartbeat; true when it shows that the component has started again."""
        if self._beat_at < now:
            self._interval = min(self._interval, now - self._beat_at)
        self._beat_at = now
        self._beats += 1
        self.is_high_latency = False
        before, self._state = self._state, message.system_status
        if message.system_status != MAV_STATE_BOOT or before in (None, MAV_STATE_BOOT):
            return False
        self._boot_ms = None  # its clock need not tell it again
        return True

    def high_latency(self) -> None:
        """HIGH_LATENCY2 has come: what it sends from now on is one of those every few seconds."""
        self.is_high_latency = True

    def system_time(self, message: SystemTime) -> bool:
        """Take a SYSTEM_TIME; true when it shows that the component has started again."""
        before, now = self._boot_ms, message.time_boot_ms
        if before is None or now >= before:
            self._boot_ms = now
            return False
        if before - now <= OUT_OF_ORDER:
            return False
        self._boot_ms = now
        return before - now < WRAP // 2

    def lost_at(self) -> float:
        """When it will be lost if nothing comes; infinity while it is lost."""
        return math.inf if self.is_lost else self.heard_at + self.patience

    def was_away(self, silence: float) -> bool:
        """Whether another vehicle may have taken its place in so many seconds."""
        patience = self.patience
        return silence >= (patience if patience < math.inf else LOST_AFTER)
