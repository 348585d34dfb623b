"""What one peer says under the address of a component, and whether two peers are the same vehicle."""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import Enum
from typing import Final, Generic, NamedTuple, TypeVar

from paramclient.model.identity import SHARED_UIDS, hardware_id
from paramclient.protocol.addresses import Peer, peer_in_words
from paramclient.protocol.vehicle.kinds import kind_in_words
from paramclient.protocol.vehicle.presence import OUT_OF_ORDER
from paramclient.protocol.wire import (
    SYSTEM_TIME_ID,
    AutopilotVersion,
    Heartbeat,
    HighLatency2,
    Message,
    SystemTime,
)

__all__ = ["Claim", "Verdict", "Variants", "compare", "compare_in_turn"]

ANOTHER_START: Final = 10.0
"""Seconds by which two starts must differ to be those of two vehicles, where one peer tells both in turn:
more than by what a clock may come late."""
TURNS: Final = 4
TURNS_WINDOW: Final = 15.0
"""How often one must follow the other in so many seconds: what comes late after a restart does so twice."""
START_TOLERANCE: Final = 2.0
"""Seconds by which the boot times of one vehicle may differ that were heard over two ways: its messages take
longer on one of them."""
CLOCK_DELAY: Final = 5.0
"""Seconds by which a clock may come late over a slow link. One that was told less than that after another
peer's start may belong to the run before that start."""
CLOCK_DRIFT: Final = 0.05
"""The share by which a vehicle's clock may go slower than ours: that of a simulation on a busy computer."""
CLAIMED_CLOCKS_MAX: Final = 4
"""Message ids whose time since boot is remembered for one peer."""
VARIANTS_MAX: Final = 8
"""Earlier variants that are remembered, of a peer that says each time that it is another vehicle."""

Value = TypeVar("Value", bound=Hashable)


class Verdict(Enum):
    """How two claims to one address stand to each other."""

    OPEN = "open"
    SAME = "the same vehicle"
    OTHER = "another vehicle"


class Variants(Generic[Value]):
    """What a peer says about one thing, and whether that alternates.

    A change is no alternation: another firmware was started, or another vehicle plugged in. It is one when
    what was said before comes back within the timeout.

    Attributes:
        current: what was said last; None before anything was.
        is_mixed: whether it alternates, until only one variant was said for the timeout.
    """

    __slots__ = ("_at", "_earlier", "current", "is_mixed")

    def __init__(self) -> None:
        self.current: Value | None = None
        self.is_mixed = False
        self._at = -math.inf
        self._earlier: dict[Value, float] = {}  # what else was said lately, and when last

    @property
    def is_moving(self) -> bool:
        """Whether something else was said within the timeout, as far as `settle` was called."""
        return bool(self._earlier)

    @property
    def all(self) -> list[Value]:
        """What was said within the timeout, the earliest first."""
        return [*self._earlier, *(() if self.current is None else (self.current,))]

    def say(self, value: Value, now: float, timeout: float) -> bool:
        """Take what is said; true when it is something else than before."""
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
        """Forget what was not said for the timeout."""
        if self._earlier:
            self._earlier = {value: at for value, at in self._earlier.items() if now - at < timeout}
        self.is_mixed = self.is_mixed and bool(self._earlier)


class _Clock(NamedTuple):
    """The time since boot in messages of one id: the start that it implies, when it was told, and what."""

    started_at: float
    told_at: float
    boot_ms: int


class _Starts:
    """The starts that messages of one id imply, as far as they lie apart.

    Attributes:
        turns: when the start was another one than in the message before, in the last 15 s.
    """

    __slots__ = ("_current", "turns")

    def __init__(self) -> None:
        self._current: float | None = None
        self.turns: list[float] = []

    def tell(self, started_at: float, now: float) -> None:
        if self._current is not None and abs(started_at - self._current) > ANOTHER_START:
            self.turns.append(now)
        self._current = started_at
        self.settle(now)

    def settle(self, now: float) -> None:
        self.turns = [at for at in self.turns if now - at < TURNS_WINDOW]

    def age(self, seconds: float) -> None:
        self.turns.clear()
        if self._current is not None:
            self._current -= seconds


class Claim:
    """What one peer says under one address.

    Attributes:
        peer: who it is.
        first_at, heard_at: when it was heard first and last.
        kind: autopilot and vehicle type of its heartbeats.
        uid: the hardware id of its AUTOPILOT_VERSION, "" where that gives none.
        asks, asked_at: how often and when it was asked who it is.
        verdict: how it stands to the peer that has the address.
        heartbeat, version: the last ones, to be taken where the peer gets the address.
        version_at: when the version came; infinity before it did.
    """

    __slots__ = (
        "_clocks",
        "_starts",
        "asked_at",
        "asks",
        "first_at",
        "heard_at",
        "heartbeat",
        "kind",
        "peer",
        "uid",
        "verdict",
        "version",
        "version_at",
    )

    def __init__(self, peer: Peer, now: float) -> None:
        self.peer = peer
        self.first_at = self.heard_at = now
        self.kind: Variants[tuple[int, int]] = Variants()
        self.uid: Variants[str] = Variants()
        self._clocks: dict[int, _Clock] = {}
        self._starts: dict[int, _Starts] = {}
        self.asks = 0
        self.asked_at = -math.inf
        self.verdict = Verdict.OPEN
        self.heartbeat: Heartbeat | None = None
        self.version: AutopilotVersion | None = None
        self.version_at = math.inf

    @property
    def is_mixed(self) -> bool:
        """Whether several vehicles speak through this peer."""
        return self.kind.is_mixed or self.uid.is_mixed or self.has_two_starts

    @property
    def has_two_starts(self) -> bool:
        """Whether the times since boot are those of several vehicles."""
        return any(len(each.turns) >= TURNS for each in self._starts.values())

    def settle(self, now: float, timeout: float) -> None:
        """Forget what was not said for the timeout."""
        self.kind.settle(now, timeout)
        self.uid.settle(now, timeout)
        for each in self._starts.values():
            each.settle(now)

    @property
    def is_moving(self) -> bool:
        """Whether something was said lately that may show that."""
        return self.kind.is_moving or self.uid.is_moving

    def take(self, message: Message, now: float, timeout: float) -> None:
        """Note what a message of this peer says of the vehicle."""
        if isinstance(message, Heartbeat | HighLatency2):
            self.kind.say((message.autopilot, message.type), now, timeout)
            if isinstance(message, Heartbeat):
                self.heartbeat = message
        elif isinstance(message, AutopilotVersion):
            self.uid.say(hardware_id(message.uid, message.uid2) or "", now, timeout)
            self.version, self.version_at = message, now
        elif isinstance(message, SystemTime):
            self.take_clock(SYSTEM_TIME_ID, message.time_boot_ms, now)

    def take_clock(self, message_id: int, boot_ms: int, now: float) -> None:
        """Note `time_boot_ms` of a message; 0 says nothing."""
        clock = self._clocks.get(message_id)
        if not boot_ms or (clock is None and len(self._clocks) >= CLAIMED_CLOCKS_MAX):
            return
        started_at = now - boot_ms / 1000
        self._starts.setdefault(message_id, _Starts()).tell(started_at, now)
        is_same_run = (
            clock is not None
            and boot_ms + 1000 * OUT_OF_ORDER >= clock.boot_ms
            and started_at <= clock.started_at + CLOCK_DELAY
        )
        if clock is not None and is_same_run:  # delays only ever make it later
            started_at = min(started_at, clock.started_at + CLOCK_DRIFT * (now - clock.told_at))
        self._clocks[message_id] = _Clock(started_at, now, boot_ms)

    @property
    def is_by_satellite(self) -> bool:
        """Whether nothing but HIGH_LATENCY2 tells what it is: that path is not asked, and no contest."""
        return self.kind.current is not None and self.heartbeat is None

    @property
    def has_own_uid(self) -> bool:
        """Whether it has given a hardware id that names one vehicle alone."""
        return bool(self.uid.current) and self.uid.current not in SHARED_UIDS

    @property
    def tells_clock(self) -> bool:
        """Whether it has told its time since boot."""
        return bool(self._clocks)

    @property
    def started_at(self) -> float:
        """When its run has begun, as it told last; minus infinity before it did."""
        told = max(self._clocks.values(), key=lambda clock: clock.told_at, default=None)
        return -math.inf if told is None else told.started_at

    def has_one_start(self, other: Claim) -> bool | None:
        """Whether the vehicle of another claim started at the same time; None where that cannot be told.

        Only times of one message are compared: each has its own delay, and some firmware fills one with
        another clock.
        """
        answers = [
            _is_one_start(clock, other._clocks[number])
            for number, clock in self._clocks.items()
            if number in other._clocks
        ]
        return False if False in answers else True if True in answers else None

    def age(self, seconds: float) -> None:
        """So much time has passed that the clock did not count."""
        self.first_at -= seconds
        self.heard_at -= seconds
        self.version_at -= seconds
        for each in self._starts.values():
            each.age(seconds)
        self._clocks = {
            number: _Clock(clock.started_at - seconds, clock.told_at - seconds, clock.boot_ms)
            for number, clock in self._clocks.items()
        }

    def in_words(self) -> str:
        """Return what it says and the peer: `PX4 quadrotor with the id 00…2a from 127.0.0.1:14550`."""
        kinds = [kind_in_words(*kind) or "an unknown kind" for kind in self.kind.all]
        words = " and ".join(dict.fromkeys(kinds)) or "no heartbeat"
        ids = " and ".join(uid for uid in self.uid.all if uid)
        words += f" with the id {ids}" if ids else ""
        words += " that tells two times since boot in turn" if self.has_two_starts else ""
        return f"{words} from {peer_in_words(self.peer)}"


def compare(mine: Claim, other: Claim, *, is_over: bool, may_ask: bool) -> tuple[Verdict, str]:
    """Return whether two claims are of one vehicle, and in words what tells them apart.

    Args:
        mine, other: the claims.
        is_over: whether everything was done to learn more.
        may_ask: whether anything could be asked at all.
    """
    kinds = mine.kind.current, other.kind.current
    uids = mine.uid.current, other.uid.current
    if None not in kinds and kinds[0] != kinds[1]:
        return Verdict.OTHER, "the autopilot or vehicle type"
    if None not in uids and uids[0] != uids[1]:
        return Verdict.OTHER, "the hardware id"
    have_one_start = mine.has_one_start(other)
    if have_one_start is False:
        return Verdict.OTHER, "the time since boot"
    uid = uids[0] if uids[0] == uids[1] else None
    if kinds[0] == kinds[1] and uid and (have_one_start or (is_over and uid not in SHARED_UIDS)):
        return Verdict.SAME, ""
    if not is_over:
        return Verdict.OPEN, ""
    if kinds[0] == kinds[1] and uids[0] == uids[1]:
        no_clock = not (mine.tells_clock or other.tells_clock)
        if have_one_start or (no_clock and not uid):
            return Verdict.SAME, ""
    if kinds[0] == kinds[1] and have_one_start and not may_ask:
        return Verdict.SAME, ""
    return Verdict.OTHER, "nothing that shows them to be one vehicle"


def compare_in_turn(mine: Claim, other: Claim, *, may_ask: bool) -> Verdict:
    """Return whether a claim is of the vehicle that has spoken under another one until it fell silent.

    It may have started again since, so only the hardware id proves that. `OPEN` where there is none to be
    compared with: the other one has not said it, or neither has one of its own.

    Args:
        mine: the claim of the one that is silent.
        other: the claim.
        may_ask: whether anything could be asked at all.
    """
    kinds = mine.kind.current, other.kind.current
    if None not in kinds and kinds[0] != kinds[1]:
        return Verdict.OTHER
    if mine.uid.current == other.uid.current:
        return Verdict.SAME if mine.has_own_uid else Verdict.OPEN
    if other.uid.current is None:
        is_heard = not may_ask and kinds[0] == kinds[1] and mine.has_one_start(other)
        return Verdict.SAME if is_heard else Verdict.OPEN
    return Verdict.OTHER if mine.uid.current or other.uid.current else Verdict.OPEN


def _is_one_start(one: _Clock, another: _Clock) -> bool | None:
    if abs(one.started_at - another.started_at) <= START_TOLERANCE:
        return True
    older, newer = sorted((one, another))
    return None if older.told_at <= newer.started_at + CLOCK_DELAY else False
