"""Presence of a component: heartbeats, silence, loss, and reboots by its clock and its heartbeats."""

from __future__ import annotations

import math
from typing import Final

from paramclient.wire.messages import MAV_STATE_BOOT, Heartbeat, SystemTime, message_id

LOST_AFTER: Final = 5.0
"""Seconds of silence after which a component with heartbeats counts as lost: five missed in a row."""
LOST_INTERVALS: Final = 3.0
"""Missed heartbeats after which a component with a slower heartbeat is lost."""
LOST_AFTER_MAX: Final = 30.0
"""Seconds of silence after which a component with heartbeats is lost, whatever their interval."""
LOST_AFTER_HIGH_LATENCY: Final = 60.0
"""The same for a component that sends HIGH_LATENCY2, as over satellite: one arrives every few seconds."""
DUPLICATE_TIME: Final = 0.2
"""Seconds between two heartbeats below which the second is a copy: ArduPilot doubles them after a restart."""
PATH_LATENCY_MAX: Final = 5.0
"""Seconds by which a message over another path may be late: vehicles are connected over radio and satellite
at once."""
REORDERING_TIME: Final = 2.0
"""Seconds by which a message may be late because the link reordered two messages."""
BOOT_CLOCK_WRAP: Final = 1 << 32
"""Where time_boot_ms wraps, after 49 days."""
SYSTEM_TIME: Final = message_id(SystemTime)
CLOCKS_MAX: Final = 64
"""Message ids whose time_boot_ms is remembered for one component: more than the dialect has."""


class Presence:
    """When a component was heard, and whether it has rebooted.

    Attributes:
        received_at, beat_at: when the last message, and the last heartbeat arrived; minus infinity before.
        is_lost: whether no message arrived for the timeout.
        base_mode: of the last heartbeat; None before the first.
        is_booting: whether the last heartbeat has MAV_STATE_BOOT.
        is_over: whether nothing more can arrive, since a log has ended: silence shows nothing then.
    """

    def __init__(self) -> None:
        self.received_at = -math.inf
        self.is_lost = False
        self.base_mode: int | None = None
        self.is_booting = False
        self.is_over = False
        self.beat_at = -math.inf
        self._interval = math.inf  # the shortest between two heartbeats
        self._is_high_latency = False
        self._clocks: dict[int, tuple[int, float]] = {}  # by message id, the last value and when
        self._rebooted_at = -math.inf

    @property
    def timeout(self) -> float:
        """Seconds of silence after which the component is lost; infinity before the first heartbeat."""
        if self.is_over or not (self.has_beaten or self._is_high_latency):
            return math.inf
        if self._is_high_latency:
            return LOST_AFTER_HIGH_LATENCY
        if self._interval == math.inf:
            return LOST_AFTER
        return min(max(LOST_AFTER, LOST_INTERVALS * self._interval), LOST_AFTER_MAX)

    @property
    def has_beaten(self) -> bool:
        """Whether a heartbeat ever arrived."""
        return self.beat_at > -math.inf

    @property
    def has_telemetry(self) -> bool:
        """Whether messages with the time since boot arrive, other than SYSTEM_TIME."""
        return not self._clocks.keys() <= {SYSTEM_TIME}

    def heartbeat(self, message: Heartbeat, now: float) -> bool:
        """Take a heartbeat, and return whether it shows a reboot: the first with MAV_STATE_BOOT does."""
        interval = now - self.beat_at
        if interval > DUPLICATE_TIME:
            self._interval = min(self._interval, interval)
        was_running = self.has_beaten and not self.is_booting
        self.beat_at = now
        self._is_high_latency = False
        self.base_mode = message.base_mode
        self.is_booting = message.system_status == MAV_STATE_BOOT
        is_new = was_running and self.is_booting and now - self._rebooted_at > PATH_LATENCY_MAX
        if is_new:
            self.rebooted(now)
        return is_new

    def high_latency(self) -> None:
        """Take a HIGH_LATENCY2: further ones arrive every few seconds."""
        self._is_high_latency = True
        self.base_mode = None

    def boot_clock(self, message_id: int, boot_ms: int, now: float) -> bool:
        """Take the `time_boot_ms` of a message, and return whether it shows a reboot.

        Only times of one message id are compared: each has its own latency, and some firmware fills one with
        0. The component has rebooted when its clock has gone back to no more than the time since the last
        message: a clock that exceeds that belongs to a late message over a longer path.
        """
        if boot_ms == 0:
            return False
        before, at = self._clocks.get(message_id, (0, now))
        passed = 1000 * (now - at)
        possible = passed + 1000 * PATH_LATENCY_MAX
        is_back = boot_ms < before and boot_ms + BOOT_CLOCK_WRAP - before > possible  # without a wrap
        if is_back and (boot_ms > possible or before + passed - boot_ms <= 1000 * REORDERING_TIME):
            return False
        is_known = now - self._rebooted_at < PATH_LATENCY_MAX
        if is_back:
            self.rebooted(now)
        if message_id in self._clocks or len(self._clocks) < CLOCKS_MAX:
            self._clocks[message_id] = (boot_ms, now)
        return is_back and not is_known

    def rebooted(self, now: float) -> None:
        """Forget the clocks: the component has rebooted."""
        self._clocks.clear()
        self._rebooted_at = now
