"""What one peer sends under the address of a component, and whether two peers are the same vehicle."""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import Enum
from typing import Final, Generic, NamedTuple, TypeVar

from paramclient.model.identity import hardware_id, is_sitl_uid
from paramclient.protocol.addresses import Peer, peer_in_words
from paramclient.protocol.vehicle.kinds import kind_in_words
from paramclient.protocol.vehicle.reboot_detection import REORDERING_TIME
from paramclient.protocol.wire import (
    SYSTEM_TIME_ID,
    AutopilotVersion,
    Heartbeat,
    HighLatency2,
    Message,
    SystemTime,
)

__all__ = ["Claim", "PeerRelation", "AlternatingValues", "compare", "compare_in_turn"]

BOOT_DIFFERENCE_MIN: Final = 10.0
"""Seconds between two boots that make them those of two vehicles, if one peer sends both alternately: more
than the latency of a clock."""
ALTERNATIONS_MIN: Final = 4
"""Alternations between two boots, within the time below, that show two vehicles: late messages after a reboot
cause two."""
ALTERNATION_WINDOW: Final = 15.0
"""Seconds in which these alternations must happen."""
BOOT_TOLERANCE: Final = 2.0
"""Seconds by which the boot times of one vehicle may differ when received over two paths: one of them has
more latency."""
CLOCK_DELAY: Final = 5.0
"""Seconds by which a clock may be late over a slow link. A clock received less than that after another peer's
boot may belong to the run before that boot."""
CLOCK_DRIFT: Final = 0.05
"""The share by which a vehicle's clock may be slower than ours: that of a simulation on a busy computer."""
CLAIMED_CLOCKS_MAX: Final = 4
"""Message ids whose time since boot is remembered for one peer."""
VARIANTS_MAX: Final = 8
"""Earlier variants that are remembered, of a peer that claims to be another vehicle each time."""

Value = TypeVar("Value", bound=Hashable)


class PeerRelation(Enum):
    """The relation of two claims to one address."""

    OPEN = "open"
    SAME = "the same vehicle"
    OTHER = "another vehicle"


class AlternatingValues(Generic[Value]):
    """The values that a peer sends for one property, and whether they alternate.

    A change is no alternation: another firmware was started, or another vehicle plugged in. It is one when an
    earlier value returns within the timeout.

    Attributes:
        current: the latest value; None before the first.
        is_mixed: whether the values alternate, until only one was received for the timeout.
    """

    __slots__ = ("_at", "_earlier", "current", "is_mixed")

    def __init__(self) -> None:
        self.current: Value | None = None
        self.is_mixed = False
        self._at = -math.inf
        self._earlier: dict[Value, float] = {}  # other recent values, and when each was received last

    @property
    def is_unsettled(self) -> bool:
        """Whether another value was received within the timeout, as of the last `settle`."""
        return bool(self._earlier)

    @property
    def all(self) -> list[Value]:
        """The values received within the timeout, the earliest first."""
        return [*self._earlier, *(() if self.current is None else (self.current,))]

    def add(self, value: Value, now: float, timeout: float) -> bool:
        """Take a value and return whether it differs from the one before."""
        if value == self.current:
            self._at = now
            return False
        self.settle(now, timeout)
        is_back = self._earlier.pop(value, None) is not None
        is_change = self.current is not None
        if self.current is not None and now - self._at < timeout:
            self._earlier[self.current] = self._at
            while len(self._earlier) > VARIANTS_MAX:
                del self._earlier[next(iter(self._earlier))]
        self.current, self._at = value, now
        self.is_mixed = self.is_mixed or is_back
        return is_change

    def settle(self, now: float, timeout: float) -> None:
        """Drop values that were not received within the timeout."""
        if self._earlier:
            self._earlier = {value: at for value, at in self._earlier.items() if now - at < timeout}
        self.is_mixed = self.is_mixed and bool(self._earlier)


class _Clock(NamedTuple):
    """The time since boot in messages of one id: the boot that it implies, when it was received, and its
    value."""

    started_at: float
    received_at: float
    boot_ms: int


class _BootTimes:
    """The boots that messages of one id imply, as far as they differ.

    Attributes:
        alternations_at: when the boot differed from that of the message before, in the last 15 s.
    """

    __slots__ = ("_current", "alternations_at")

    def __init__(self) -> None:
        self._current: float | None = None
        self.alternations_at: list[float] = []

    def add(self, started_at: float, now: float) -> None:
        if self._current is not None and abs(started_at - self._current) > BOOT_DIFFERENCE_MIN:
            self.alternations_at.append(now)
        self._current = started_at
        self.settle(now)

    def settle(self, now: float) -> None:
        self.alternations_at = [at for at in self.alternations_at if now - at < ALTERNATION_WINDOW]

    def age(self, seconds: float) -> None:
        self.alternations_at.clear()
        if self._current is not None:
            self._current -= seconds


class Claim:
    """What one peer sends under one address.

    Attributes:
        peer: the peer.
        first_at, received_at: when its first and last message were received.
        kind: autopilot and vehicle type of its heartbeats.
        uid: the hardware id of its AUTOPILOT_VERSION, "" where that has none.
        requests, requested_at: the number of identity requests to it, and the time of the last.
        verdict: its relation to the peer with the address.
        heartbeat, version: its last ones, used when it becomes the peer with the address.
        version_at: when the version was received; infinity before.
    """

    __slots__ = (
        "_clocks",
        "_starts",
        "first_at",
        "heartbeat",
        "kind",
        "peer",
        "received_at",
        "requested_at",
        "requests",
        "uid",
        "verdict",
        "version",
        "version_at",
    )

    def __init__(self, peer: Peer, now: float) -> None:
        self.peer = peer
        self.first_at = self.received_at = now
        self.kind: AlternatingValues[tuple[int, int]] = AlternatingValues()
        self.uid: AlternatingValues[str] = AlternatingValues()
        self._clocks: dict[int, _Clock] = {}
        self._starts: dict[int, _BootTimes] = {}
        self.requests = 0
        self.requested_at = -math.inf
        self.verdict = PeerRelation.OPEN
        self.heartbeat: Heartbeat | None = None
        self.version: AutopilotVersion | None = None
        self.version_at = math.inf

    @property
    def is_mixed(self) -> bool:
        """Whether several vehicles send through this peer."""
        return self.kind.is_mixed or self.uid.is_mixed or self.has_two_starts

    @property
    def has_two_starts(self) -> bool:
        """Whether the times since boot are those of several vehicles."""
        return any(len(each.alternations_at) >= ALTERNATIONS_MIN for each in self._starts.values())

    def settle(self, now: float, timeout: float) -> None:
        """Drop values that were not received within the timeout."""
        self.kind.settle(now, timeout)
        self.uid.settle(now, timeout)
        for each in self._starts.values():
            each.settle(now)

    @property
    def is_unsettled(self) -> bool:
        """Whether recent values may show that."""
        return self.kind.is_unsettled or self.uid.is_unsettled

    def take(self, message: Message, now: float, timeout: float) -> None:
        """Record what a message of this peer says about the vehicle."""
        if isinstance(message, Heartbeat | HighLatency2):
            self.kind.add((message.autopilot, message.type), now, timeout)
            if isinstance(message, Heartbeat):
                self.heartbeat = message
        elif isinstance(message, AutopilotVersion):
            self.uid.add(hardware_id(message.uid, message.uid2) or "", now, timeout)
            self.version, self.version_at = message, now
        elif isinstance(message, SystemTime):
            self.take_clock(SYSTEM_TIME_ID, message.time_boot_ms, now)

    def take_clock(self, message_id: int, boot_ms: int, now: float) -> None:
        """Record `time_boot_ms` of a message; 0 is ignored."""
        clock = self._clocks.get(message_id)
        if not boot_ms or (clock is None and len(self._clocks) >= CLAIMED_CLOCKS_MAX):
            return
        started_at = now - boot_ms / 1000
        self._starts.setdefault(message_id, _BootTimes()).add(started_at, now)
        is_same_run = (
            clock is not None
            and boot_ms + 1000 * REORDERING_TIME >= clock.boot_ms
            and started_at <= clock.started_at + CLOCK_DELAY
        )
        if clock is not None and is_same_run:  # latency only ever makes it later
            started_at = min(started_at, clock.started_at + CLOCK_DRIFT * (now - clock.received_at))
        self._clocks[message_id] = _Clock(started_at, now, boot_ms)

    @property
    def is_by_satellite(self) -> bool:
        """Whether only HIGH_LATENCY2 says what it is: such a path gets no requests and is no contest."""
        return self.kind.current is not None and self.heartbeat is None

    @property
    def has_own_uid(self) -> bool:
        """Whether it has sent a hardware id that is unique to one vehicle."""
        return bool(self.uid.current) and not is_sitl_uid(self.uid.current)

    @property
    def reports_clock(self) -> bool:
        """Whether it has sent its time since boot."""
        return bool(self._clocks)

    @property
    def started_at(self) -> float:
        """The last boot time that it has implied; minus infinity before."""
        newest_clock = max(self._clocks.values(), key=lambda clock: clock.received_at, default=None)
        return -math.inf if newest_clock is None else newest_clock.started_at

    def has_one_start(self, other: Claim) -> bool | None:
        """Return whether another claim's vehicle booted at the same time; None while unknown.

        Only times of one message are compared: each has its own latency, and some firmware fills one with
        another clock.
        """
        answers = [
            _is_one_start(clock, other._clocks[number])
            for number, clock in self._clocks.items()
            if number in other._clocks
        ]
        return False if False in answers else True if True in answers else None

    def age(self, seconds: float) -> None:
        """Move all moments back by time that the clock left out."""
        self.first_at -= seconds
        self.received_at -= seconds
        self.version_at -= seconds
        for each in self._starts.values():
            each.age(seconds)
        self._clocks = {
            number: _Clock(clock.started_at - seconds, clock.received_at - seconds, clock.boot_ms)
            for number, clock in self._clocks.items()
        }

    def in_words(self) -> str:
        """Return vehicle and peer as text: `PX4 quadrotor with the id 00…2a from 127.0.0.1:14550`."""
        kinds = [kind_in_words(*kind) or "an unknown kind" for kind in self.kind.all]
        words = " and ".join(dict.fromkeys(kinds)) or "no heartbeat"
        ids = " and ".join(uid for uid in self.uid.all if uid)
        words += f" with the id {ids}" if ids else ""
        words += " that reports two times since boot in turn" if self.has_two_starts else ""
        return f"{words} from {peer_in_words(self.peer)}"


def compare(home: Claim, other: Claim, *, is_over: bool, may_ask: bool) -> tuple[PeerRelation, str]:
    """Return whether two claims are of one vehicle, and their difference as text.

    Args:
        home, other: the claims.
        is_over: whether all requests that could show more were sent.
        may_ask: whether requests may be sent at all.
    """
    kinds = home.kind.current, other.kind.current
    uids = home.uid.current, other.uid.current
    if None not in kinds and kinds[0] != kinds[1]:
        return PeerRelation.OTHER, "the autopilot or vehicle type"
    if None not in uids and uids[0] != uids[1]:
        return PeerRelation.OTHER, "the hardware id"
    have_one_start = home.has_one_start(other)
    if have_one_start is False:
        return PeerRelation.OTHER, "the time since boot"
    uid = uids[0] if uids[0] == uids[1] else None
    # an id is sent in clear: a peer that repeats it, and no clock, is not the vehicle that sends one
    has_equal_clocks = home.reports_clock == other.reports_clock or not may_ask
    is_enough = is_over and has_equal_clocks and uid is not None and not is_sitl_uid(uid)
    if kinds[0] == kinds[1] and uid and (have_one_start or is_enough):
        return PeerRelation.SAME, ""
    if not is_over:
        return PeerRelation.OPEN, ""
    if kinds[0] == kinds[1] and uids[0] == uids[1]:
        no_clock = not (home.reports_clock or other.reports_clock)
        if have_one_start or (no_clock and not uid):
            return PeerRelation.SAME, ""
    if kinds[0] == kinds[1] and have_one_start and not may_ask:
        return PeerRelation.SAME, ""
    return PeerRelation.OTHER, "nothing that shows them to be one vehicle"


def compare_in_turn(home: Claim, other: Claim, *, may_ask: bool) -> PeerRelation:
    """Return whether a claim is of the vehicle that has sent under another one until it went silent.

    The vehicle may have rebooted since, so only the hardware id proves that. `OPEN` where there is none to
    compare: the other claim has not received it, or neither has a unique one.

    Args:
        home: the claim of the silent peer.
        other: the claim.
        may_ask: whether requests may be sent at all.
    """
    kinds = home.kind.current, other.kind.current
    if None not in kinds and kinds[0] != kinds[1]:
        return PeerRelation.OTHER
    if home.uid.current == other.uid.current:
        return PeerRelation.SAME if home.has_own_uid else PeerRelation.OPEN
    if other.uid.current is None:
        is_same = not may_ask and kinds[0] == kinds[1] and home.has_one_start(other)
        return PeerRelation.SAME if is_same else PeerRelation.OPEN
    return PeerRelation.OTHER if home.uid.current or other.uid.current else PeerRelation.OPEN


def _is_one_start(one: _Clock, another: _Clock) -> bool | None:
    if abs(one.started_at - another.started_at) <= BOOT_TOLERANCE:
        return True
    older, newer = sorted((one, another))
    return None if older.received_at <= newer.started_at + CLOCK_DELAY else False
