"""Detection of a component's reboots: its heartbeat's state, its times since boot, its sequence numbers."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.wire import MAV_STATE_BOOT, SYSTEM_TIME_ID, SystemTime

__all__ = ["RebootDetection"]

REORDERING_TIME: Final = 2.0
"""Seconds by which a message may be late because the link reordered two messages."""
PATH_LATENCY_MAX: Final = 5.0
"""Seconds by which a message over another path may be late: vehicles are connected over radio and satellite
at once."""
BOOT_CLOCK_WRAP: Final = 1 << 32
"""Where time_boot_ms wraps, after 49 days."""
CLOCKS_MAX: Final = 64
"""Message ids whose time_boot_ms is remembered for one component: more than the dialect has."""
FIRST_FRAMES: Final = 8
"""Sequence numbers from 0 on that belong to the first frames of a numbering: some may be lost."""
SEQUENCE_GAP: Final = 8
"""Frames, at least, between two sequence numbers for the second one not to be the usual wrap at 255."""


class RebootDetection:
    """Reboots of a component: MAV_STATE_BOOT in a heartbeat, or a time since boot that has gone back.

    Attributes:
        clock_at: when the last time since boot was received; minus infinity before the first.
        state: MAV_STATE of the last heartbeat; None before the first.
    """

    __slots__ = (
        "_boot_beat_at",
        "_boot_ms",
        "_clocks",
        "_restarted_at",
        "_sequence",
        "_started_before",
        "clock_at",
        "state",
    )

    def __init__(self) -> None:
        self.state: int | None = None
        self._boot_beat_at = -math.inf  # the last heartbeat with MAV_STATE_BOOT
        self.clock_at = -math.inf
        self._boot_ms: int | None = None  # the value received then
        self._clocks: dict[int, tuple[int, float]] = {}  # by message id, the last value and when
        self._restarted_at = -math.inf  # when a reboot was detected last
        self._started_before = -math.inf  # the boot time of the run before that, if known
        self._sequence: int | None = None

    @property
    def is_booting(self) -> bool:
        """Whether its last heartbeat has MAV_STATE_BOOT."""
        return self.state == MAV_STATE_BOOT

    @property
    def started_at(self) -> float | None:
        """Its latest boot time by its clock, which includes latency; None before the first clock."""
        return None if self._boot_ms is None else self.clock_at - self._boot_ms / 1000

    def age(self, seconds: float) -> None:
        """Move all moments back by time that the clock left out."""
        self._boot_beat_at -= seconds
        self.clock_at -= seconds
        self._restarted_at -= seconds
        self._started_before -= seconds
        self._clocks = {number: (boot_ms, at - seconds) for number, (boot_ms, at) in self._clocks.items()}

    def _status(self, state: int, now: float) -> bool:
        """Process the MAV_STATE of a heartbeat and return whether it shows a reboot."""
        before, self.state = self.state, state
        if state != MAV_STATE_BOOT:
            return False
        is_late = now - self._boot_beat_at <= REORDERING_TIME
        self._boot_beat_at = now
        if before in (None, MAV_STATE_BOOT) or is_late:
            return False
        self.forget_clock(now)  # its clock need not show it again
        return True

    def forget_clock(self, now: float) -> None:
        """Forget the clock after a reboot that the clock has not shown: its next value shows no other
        reboot."""
        started_at = self.started_at
        self._started_before = -math.inf if started_at is None else started_at
        self._clocks.clear()
        self._boot_ms = None
        self._restarted_at = now

    def numbering_begins(self, sequence: int) -> bool:
        """Process a sequence number and return whether a numbering may begin with it, as after a boot.

        That is a hint and no proof: with a lot of traffic the numbers pass 0 several times a second.
        """
        before, self._sequence = self._sequence, sequence
        return before is not None and sequence < FIRST_FRAMES and (sequence - before) % 256 >= SEQUENCE_GAP

    def system_time(self, message: SystemTime, now: float) -> bool:
        """Process a SYSTEM_TIME and return whether it shows a reboot."""
        return self._clock(SYSTEM_TIME_ID, message.time_boot_ms, now)

    def boot_clock(self, message_id: int, boot_ms: int, now: float) -> bool:
        """Process `time_boot_ms` of any message and return whether it shows a reboot.

        Only times of one message id are compared: each has its own latency, and some firmware fills one with
        another clock, or with 0, which is ignored.
        """
        return boot_ms > 0 and self._clock(message_id, boot_ms, now)

    def _clock(self, message_id: int, boot_ms: int, now: float) -> bool:
        """Compare a time with the one before it.

        The component has rebooted when its clock has gone back and does not exceed the time since the last
        message before. A clock that has gone back and exceeds it belongs to a late message over a longer
        path.
        """
        if self._is_of_run_before(now - boot_ms / 1000, now):
            return False
        before, before_at = self._clocks.get(message_id, (None, 0.0))
        has_started_again = False
        if before is not None and boot_ms < before:
            passed = 1000 * (now - before_at)
            possible = passed + 1000 * PATH_LATENCY_MAX
            has_wrapped = boot_ms + BOOT_CLOCK_WRAP - before <= possible
            is_late = boot_ms > possible or before + passed - boot_ms <= 1000 * REORDERING_TIME
            if is_late and not has_wrapped:
                return False
            has_started_again = not has_wrapped
        if has_started_again:
            self.forget_clock(now)
        if message_id in self._clocks or len(self._clocks) < CLOCKS_MAX:
            self._clocks[message_id] = (boot_ms, now)
        self._boot_ms, self.clock_at = boot_ms, now
        return has_started_again

    def _is_of_run_before(self, started_at: float, now: float) -> bool:
        """Return whether a time is a late one, from before the last detected reboot.

        Args:
            started_at: the boot time that it implies.
            now: the time.
        """
        is_recent = now - self._restarted_at < PATH_LATENCY_MAX
        return (
            is_recent
            and started_at
            < min(self._restarted_at, self._started_before + 2 * PATH_LATENCY_MAX) - PATH_LATENCY_MAX
        )
