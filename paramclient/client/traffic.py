"""Traffic of a link by component and message: counts, rates and losses."""

from __future__ import annotations

import struct
from collections import Counter, defaultdict, deque
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, TypeAlias

import anyio

from paramclient.client.taps import FrameCutter, SeenFrame, Tap
from paramclient.protocol.addresses import Address
from paramclient.wire.loss import SequenceCheck
from paramclient.wire.messages import Heartbeat, decode

RATE_SLICES: Final = 10
"""Slices over which rates and losses are measured, 5 s: several heartbeats, and short enough to adjust an
antenna."""
RATE_SLICE: Final = 0.5
"""Seconds of a slice."""
RATE_TIME_MIN: Final = 1.0
"""Seconds, at least, over which a rate is computed."""
RADIO_STATUS_IDS: Final = frozenset({109, 166})
"""RADIO_STATUS, and RADIO from older firmware of SiK radios; both have the same layout."""

_RADIO_STATUS = struct.Struct("<HHBBBBB")
_What: TypeAlias = str | int  # a number is a message id


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """The last status of a telemetry radio, in its own units (SiK: 0 to 254, about half a dB each).

    Attributes:
        errors, fixed: packets with errors, and corrected ones.
        rssi, noise: signal and noise at this end.
        remote_rssi, remote_noise: at the other end.
        free: free percentage of its transmit buffer.
    """

    errors: int
    fixed: int
    rssi: int
    remote_rssi: int
    free: int
    noise: int
    remote_noise: int


@dataclass(slots=True)
class ComponentTraffic:
    """The traffic of one component. Times are of the event loop's clock.

    Attributes:
        system, component: its address.
        version: the MAVLink version of its last frame, 1 or 2.
        received_at: time of its last frame.
        heartbeat, heartbeat_at: its last HEARTBEAT and the time of it, or None.
        radio: its status, if it is a radio.
        totals: since the link was opened: `frames`, `bytes`, `signed` (frames with a signature, which is not
            verified), `lost` (by the gaps in the sequence numbers, see `SequenceCheck`), `repeated`, `late`
            (received after a later frame); and frames by message id.
        recent: the same per second, of the last seconds.
    """

    system: int
    component: int
    version: int = 1
    received_at: float = 0.0
    heartbeat: Heartbeat | None = None
    heartbeat_at: float | None = None
    radio: RadioStatus | None = None
    totals: Counter[_What] = field(default_factory=Counter)
    recent: Mapping[_What, float] = field(default_factory=dict)

    @property
    def messages(self) -> list[int]:
        """Ids of its messages, the most frequent one first."""
        ids = [what for what in self.totals if isinstance(what, int)]
        return sorted(ids, key=lambda each: (-self.recent[each], -self.totals[each], each))

    @property
    def loss(self) -> float | None:
        """The share of its recent frames that was lost, 0 to 1; None without recent frames."""
        received, lost = self.recent["frames"] - self.recent["repeated"], max(self.recent["lost"], 0.0)
        return lost / (received + lost) if received > 0 else None


@dataclass(frozen=True, slots=True)
class TrafficReport:
    """The traffic of a link.

    Attributes:
        at: when it was made, by the event loop's clock.
        seconds: the observed time.
        components: by address.
        totals: since the link was opened: `received` and `sent` bytes, whole `frames` received, and those of
            them with an `unknown` id.
        recent: the same per second, of the last seconds.
        damaged: frames with a wrong checksum.
        other_bytes: received bytes outside of frames.
    """

    at: float
    seconds: float
    components: tuple[ComponentTraffic, ...]
    totals: Counter[_What]
    recent: Mapping[_What, float]
    damaged: int
    other_bytes: int


class Traffic(Tap):
    """Counts all traffic of a link, as a tap; on request only: an ordinary client does without."""

    def __init__(self) -> None:
        self._began = 0.0
        self._counts: Counter[tuple[Address | None, _What]] = Counter()  # None: of the link
        self._components: dict[Address, ComponentTraffic] = {}
        self._checks: defaultdict[Hashable, SequenceCheck] = defaultdict(SequenceCheck)  # by address and peer
        # the counts before each of the last slices in which something was counted
        self._before: deque[tuple[int, Counter[tuple[Address | None, _What]]]] = deque(maxlen=RATE_SLICES)

    async def open(self) -> None:
        """Begin to observe."""
        self._began = anyio.current_time()

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Count a received chunk and its frames."""
        now = self._count(None, received=size, frames=len(frames))
        for seen in frames:
            frame = seen.frame
            address = (frame.system, frame.component)
            self._count(None, unknown=not seen.is_known)
            if not seen.is_known and address not in self._components:
                continue  # an address that no checksum proves does not count
            source = self._components.setdefault(address, ComponentTraffic(*address))
            source.received_at, source.version = now, frame.version
            check = self._checks[address, peer]
            lost, repeated, late = check.lost, check.repeated, check.late
            check.receive(frame.sequence, now)
            self._count(address, lost=check.lost - lost, repeated=check.repeated - repeated)
            self._count(address, late=check.late - late, frames=1, bytes=seen.size, signed=seen.is_signed)
            self._counts[address, frame.message_id] += 1
            if frame.message_id in RADIO_STATUS_IDS:
                payload = frame.payload.ljust(_RADIO_STATUS.size, b"\0")
                source.radio = RadioStatus(*_RADIO_STATUS.unpack_from(payload))
            elif seen.is_known and isinstance(message := decode(frame), Heartbeat):
                source.heartbeat, source.heartbeat_at = message, now

    def sent(self, frame: bytes) -> None:
        """Count a sent frame."""
        self._count(None, sent=len(frame))

    def report(self, now: float, cutter: FrameCutter) -> TrafficReport:
        """Return the present counts, and those of the cutter of the received data."""
        first = int(now / RATE_SLICE) - RATE_SLICES + 1
        window = max(now - max(first * RATE_SLICE, self._began), RATE_TIME_MIN)
        before = next((counts for number, counts in self._before if number >= first), self._counts)
        totals: defaultdict[Address | None, Counter[_What]] = defaultdict(Counter)
        recent: defaultdict[Address | None, defaultdict[_What, float]]
        recent = defaultdict(partial(defaultdict, float))
        for (whose, what), count in self._counts.items():
            totals[whose][what] = count
            recent[whose][what] = (count - before[whose, what]) / window
        return TrafficReport(
            at=now,
            seconds=now - self._began,
            components=tuple(
                replace(each, totals=totals[address], recent=recent[address])
                for address, each in sorted(self._components.items())
            ),
            totals=totals[None],
            recent=recent[None],
            damaged=cutter.damaged,
            other_bytes=cutter.other_bytes,
        )

    def _count(self, whose: Address | None, **increases: int) -> float:
        """Increase counts of a component or of the link. Return the time."""
        now = anyio.current_time()
        number = int(now / RATE_SLICE)
        if not self._before or self._before[-1][0] != number:
            self._before.append((number, self._counts.copy()))
        for what, increase in increases.items():
            self._counts[whose, what] += increase
        return now
