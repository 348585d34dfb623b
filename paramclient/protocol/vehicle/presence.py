"""Whether a component is there: its heartbeats, its silence, its reboots."""

from __future__ import annotations

import math
from typing import Final

from paramclient.protocol.wire import MAV_STATE_BOOT, SYSTEM_TIME_ID, Heartbeat, SystemTime

__all__ = ["Presence"]

LOST_AFTER: Final = 5.0
"""Seconds without a word after which a component that sent heartbeats counts as lost: five in a row."""
BEATS_TO_MISS: Final = 3.0
"""For one that is known to send fewer heartbeats than one a second: so many of its own intervals."""
LONGEST_PATIENCE: Final = 60.0
"""The most that comes to: two heartbeats far apart may as well be those of one that was away between them."""
USUAL_INTERVAL: Final = 1.0
"""Seconds from one heartbeat to the next, by the standard."""
BEATS_IN_A_GAP: Final = 2.5
"""Intervals of silence in which an update may have been lost as well: two heartbeats were."""
BEATS_OVERDUE: Final = 1.5
"""The same after which one is late: the link, or whoever is behind with all that there is to do, owes it."""
COPY: Final = 0.5
"""Seconds within which a second heartbeat is one that came twice, or late."""
LOST_AFTER_HIGH_LATENCY: Final = 20.0
"""The same in high-latency mode, where PX4 sends one HIGH_LATENCY2 every 5 seconds and nothing else."""
OUT_OF_ORDER: Final = 2.0
"""Seconds by which one message may be late because a link brought two of them in the wrong order."""
DETOUR: Final = 5.0
"""Seconds by which a message may be late that took another way: vehicles are heard over radio and satellite
at once."""
WRAP: Final = 1 << 32
"""Where time_boot_ms begins anew, after 49 days."""
CLOCKS_MAX: Final = 64
"""Message ids whose time_boot_ms is remembered for one component: more than the dialect has."""
FIRST_FRAMES: Final = 8
"""Sequence numbers from 0 on that belong to the first frames of a numbering: some may be lost."""
SEQUENCE_GAP: Final = 8
"""Frames that must lie between two sequence numbers for the second one not to be the usual step over 255."""


class Presence:
    """What a component's own messages tell of its coming, going and starting again.

    A component that never sent a heartbeat is never lost: nothing says when it should have been heard.

    Attributes:
        beat_at: when a heartbeat came last; minus infinity before one did.
        base_mode: MAV_MODE_FLAG bits of that heartbeat; None before one came, and while it is known that
            others follow of which none is heard.
        gap: seconds of silence from which on something may have been missed.
        heard_at: when anything came from it last.
        clock_at: when a message told its time since boot last; minus infinity before one did.
        is_lost: whether it has been silent for too long since.
        since: when it was heard first, or again after it was lost.
        state: MAV_STATE of the last heartbeat; None before one came.
        is_high_latency: whether it said so: HIGH_LATENCY2 came, and no heartbeat since.
    """

    __slots__ = (
        "_boot_beat_at",
        "_boot_ms",
        "_clocks",
        "_interval",
        "_restarted_at",
        "_sequence",
        "_started_before",
        "base_mode",
        "beat_at",
        "clock_at",
        "gap",
        "heard_at",
        "is_high_latency",
        "is_lost",
        "since",
        "state",
    )

    def __init__(self) -> None:
        self.heard_at = -math.inf
        self.is_lost = False
        self.since = math.inf
        self.is_high_latency = False
        self.gap = BEATS_IN_A_GAP * USUAL_INTERVAL
        self.beat_at = -math.inf
        self.base_mode: int | None = None
        self._interval = math.inf  # the shortest time between two heartbeats: the others were lost
        self.state: int | None = None
        self._boot_beat_at = -math.inf  # the last heartbeat that said it was booting
        self.clock_at = -math.inf
        self._boot_ms: int | None = None  # as told then
        self._clocks: dict[int, tuple[int, float]] = {}  # by message id, what was told last, and when
        self._restarted_at = -math.inf  # when a restart was recognized last
        self._started_before = -math.inf  # when the run before that had begun, if it told
        self._sequence: int | None = None

    @property
    def patience(self) -> float:
        """Seconds of silence after which it is lost; infinity as long as nothing can be expected of it."""
        if self.is_high_latency:
            return LOST_AFTER_HIGH_LATENCY
        if not self.has_beaten:
            return math.inf
        if self._interval == math.inf:
            return LOST_AFTER
        return min(max(LOST_AFTER, BEATS_TO_MISS * self._interval), LONGEST_PATIENCE)

    @property
    def has_beaten(self) -> bool:
        """Whether it ever sent a heartbeat."""
        return self.beat_at > -math.inf

    def is_overdue(self, now: float) -> bool:
        """Whether it should have been heard since, and is not lost yet: what it owes besides says nothing."""
        late = BEATS_OVERDUE / BEATS_IN_A_GAP * self.gap
        return self.has_beaten and not self.is_lost and now - self.heard_at > late

    @property
    def is_booting(self) -> bool:
        """Whether its last heartbeat said so."""
        return self.state == MAV_STATE_BOOT

    @property
    def started_at(self) -> float | None:
        """When it has started by what its clock told last, or later by what that took; None before it did."""
        return None if self._boot_ms is None else self.clock_at - self._boot_ms / 1000

    def heard(self, now: float) -> float:
        """Anything has come. Gives the seconds of silence before it: infinity for the first word."""
        silence = now - self.heard_at
        self.heard_at = now
        return silence

    def age(self, seconds: float) -> None:
        """So much time has passed that the clock did not count."""
        self.heard_at -= seconds
        self.beat_at -= seconds
        self._boot_beat_at -= seconds
        self.clock_at -= seconds
        self._restarted_at -= seconds
        self._started_before -= seconds
        self._clocks = {number: (told, at - seconds) for number, (told, at) in self._clocks.items()}

    def heartbeat(self, message: Heartbeat, now: float) -> bool:
        """Take a heartbeat; true when it shows that the component has started again."""
        interval = now - self.beat_at
        if COPY <= interval < self._interval:
            self._interval = interval
            self.gap = BEATS_IN_A_GAP * max(interval, USUAL_INTERVAL)
        self.beat_at = now
        self.base_mode = message.base_mode
        self.is_high_latency = False
        before, self.state = self.state, message.system_status
        if message.system_status != MAV_STATE_BOOT:
            return False
        is_late = now - self._boot_beat_at <= OUT_OF_ORDER
        self._boot_beat_at = now
        if before in (None, MAV_STATE_BOOT) or is_late:
            return False
        self.forget_clock(now)  # it need not tell it again
        return True

    def forget_clock(self, now: float) -> None:
        """It has started again, which its clock has not shown: what that tells next is no other restart."""
        started_at = self.started_at
        self._started_before = -math.inf if started_at is None else started_at
        self._clocks.clear()
        self._boot_ms = None
        self._restarted_at = now

    def numbering_begins(self, sequence: int) -> bool:
        """Take a frame's sequence number; true when a numbering may begin with it, as after a start.

        That is a hint and no proof: the numbers of one that sends a lot pass 0 several times a second.
        """
        before, self._sequence = self._sequence, sequence
        return before is not None and sequence < FIRST_FRAMES and (sequence - before) % 256 >= SEQUENCE_GAP

    def high_latency(self) -> None:
        """HIGH_LATENCY2 has come: what it sends from now on is one of those every few seconds."""
        self.is_high_latency = True
        self.base_mode = None

    def system_time(self, message: SystemTime, now: float) -> bool:
        """Take a SYSTEM_TIME; true when it shows that the component has started again."""
        return self._clock(SYSTEM_TIME_ID, message.time_boot_ms, now)

    def boot_clock(self, message_id: int, boot_ms: int, now: float) -> bool:
        """Take `time_boot_ms` of any message; true when it shows that the component has started again.

        Only times of one message id are compared: each has its own delay, and some firmware fills one with
        another clock, or with 0, which says nothing.
        """
        return boot_ms > 0 and self._clock(message_id, boot_ms, now)

    def _clock(self, message_id: int, boot_ms: int, now: float) -> bool:
        """Compare a time with the one before it.

        The component has started again when its clock has gone back, and is no further than the time since
        it was heard before. One that has gone back and is further is an old message that took a longer way.
        """
        if self._is_of_run_before(now - boot_ms / 1000, now):
            return False
        before, before_at = self._clocks.get(message_id, (None, 0.0))
        has_started_again = False
        if before is not None and boot_ms < before:
            passed = 1000 * (now - before_at)
            possible = passed + 1000 * DETOUR
            has_wrapped = boot_ms + WRAP - before <= possible
            is_late = boot_ms > possible or before + passed - boot_ms <= 1000 * OUT_OF_ORDER
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
        """Whether a time comes late, from before the restart that was recognized just now.

        Args:
            started_at: the start that the time implies.
            now: the time.
        """
        is_recent = now - self._restarted_at < DETOUR
        return is_recent and started_at < min(self._restarted_at, self._started_before + 2 * DETOUR) - DETOUR

    def lost_at(self) -> float:
        """When it will be lost if nothing comes; infinity while it is lost."""
        return math.inf if self.is_lost else self.heard_at + self.patience

    def was_away(self, silence: float) -> bool:
        """Whether another vehicle may have taken its place in so many seconds."""
        patience = self.patience
        return silence >= (patience if patience < math.inf else LOST_AFTER)
