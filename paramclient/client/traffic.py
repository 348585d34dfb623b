"""Traffic of a link by component and message: counts, rates and losses."""

from __future__ import annotations

import math
import struct
from collections import Counter, defaultdict, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import anyio

from paramclient.client.taps import FrameCutter, SeenFrame, Tap
from paramclient.protocol.addresses import Address
from paramclient.wire.frames import message_name
from paramclient.wire.loss import SequenceCheck
from paramclient.wire.messages import Heartbeat, decode

__all__ = ["ComponentTraffic", "MessageTraffic", "RadioStatus", "Traffic", "TrafficReport"]

RATE_WINDOW: Final = 5.0
"""Seconds over which rates and losses are measured: several heartbeats, and short enough to adjust an
antenna."""
RATE_SLICE: Final = 0.5
"""Seconds between two snapshots of the counts in that time."""
RATE_TIME_MIN: Final = 1.0
"""Seconds, at least, over which a rate is computed."""
RADIO_STATUS_IDS: Final = frozenset({109, 166})
"""RADIO_STATUS, and RADIO from older firmware of SiK radios; both have the same layout."""


@dataclass(frozen=True, slots=True)
class MessageTraffic:
    """One kind of message from one component.

    Attributes:
        name: `HEARTBEAT`, …; `UNKNOWN_4711` for an id outside the dialect.
        message_id: its number.
        count: frames since the link was opened.
        rate: recent frames per second.
    """

    name: str
    message_id: int
    count: int
    rate: float


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """The last status of a telemetry radio, in its own units (SiK: 0 to 254, about half a dB each).

    Attributes:
        rssi, noise: signal and noise at this end.
        remote_rssi, remote_noise: at the other end.
        free: free percentage of its transmit buffer.
        errors, fixed: packets received with errors, and the corrected ones among them, since its start.
    """

    rssi: int
    noise: int
    remote_rssi: int
    remote_noise: int
    free: int
    errors: int
    fixed: int


@dataclass(frozen=True, slots=True)
class ComponentTraffic:
    """The traffic of one component since the link was opened; rates and `loss` are recent ones.

    Attributes:
        system, component: its address.
        version: the MAVLink version of its last frame, 1 or 2.
        heartbeat: its last HEARTBEAT, or None.
        heartbeat_age: seconds since that, or None.
        age: seconds since its last frame.
        frames, bytes: received in total.
        frame_rate, byte_rate: per second.
        lost: lost frames, by the gaps in their numbers; see `SequenceCheck` for the rule.
        loss: the share of its frames that was lost, 0 to 1; None without recent frames.
        repeated, late: frames received twice, or after a later one.
        signed: frames with a signature; it is not verified.
        messages: by kind, the most frequent one first.
        radio: its status, if it is a radio.
    """

    system: int
    component: int
    version: int
    heartbeat: Heartbeat | None
    heartbeat_age: float | None
    age: float
    frames: int
    bytes: int
    frame_rate: float
    byte_rate: float
    lost: int
    loss: float | None
    repeated: int
    late: int
    signed: int
    messages: tuple[MessageTraffic, ...]
    radio: RadioStatus | None


@dataclass(frozen=True, slots=True)
class TrafficReport:
    """The traffic of a link.

    Attributes:
        seconds: the observed time.
        components: by address.
        bytes_received, bytes_sent: in total.
        received_rate, sent_rate: recent bytes per second.
        frames: whole frames received.
        damaged: frames with a wrong checksum.
        unknown: frames with an id outside the dialect; included in `frames`.
        other_bytes: received bytes outside of frames.
    """

    seconds: float
    components: tuple[ComponentTraffic, ...]
    bytes_received: int
    bytes_sent: int
    received_rate: float
    sent_rate: float
    frames: int
    damaged: int
    unknown: int
    other_bytes: int


class Traffic(Tap):
    """Counts all traffic of a link, as a tap; on request only: an ordinary client does without."""

    def __init__(self) -> None:
        self._counts = _Counts()
        self._sources: dict[Address, _Source] = {}

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Count a received chunk and its frames."""
        now = anyio.current_time()
        counts = self._counts.at(now)
        counts["received"] += size
        counts["frames"] += len(frames)
        for each in frames:
            address = (each.frame.system, each.frame.component)
            counts["unknown"] += not each.is_known
            source = self._sources.get(address)
            if source is None:
                if not each.is_known:
                    continue  # an address that no checksum proves does not count
                source = self._sources[address] = _Source()
            source.receive(each, peer, now)

    def sent(self, frame: bytes) -> None:
        """Count a sent frame."""
        self._counts.at(anyio.current_time())["sent"] += len(frame)

    def report(self, now: float, cutter: FrameCutter) -> TrafficReport:
        """Return the present counts, and those of the cutter of the received data."""
        began = min(self._counts.began, now)
        window = max(now - max(_first_slice(now) * RATE_SLICE, began), RATE_TIME_MIN)
        totals, recent = self._counts.totals, self._counts.recent(now)
        return TrafficReport(
            seconds=now - began,
            components=tuple(
                source.report(address, window, now) for address, source in sorted(self._sources.items())
            ),
            bytes_received=totals["received"],
            bytes_sent=totals["sent"],
            received_rate=recent["received"] / window,
            sent_rate=recent["sent"] / window,
            frames=totals["frames"],
            damaged=cutter.damaged,
            unknown=totals["unknown"],
            other_bytes=cutter.other_bytes,
        )


class _Source:
    """One component's frames."""

    def __init__(self) -> None:
        self._counts = _Counts()
        self._checks: defaultdict[Hashable, SequenceCheck] = defaultdict(SequenceCheck)  # by peer
        self._version = 1
        self._received_at = 0.0
        self._heartbeat: Heartbeat | None = None
        self._heartbeat_at = 0.0
        self._radio: RadioStatus | None = None

    def receive(self, seen: SeenFrame, peer: Hashable, now: float) -> None:
        """Count a frame."""
        frame = seen.frame
        self._received_at = now
        self._version = frame.version
        check = self._checks[peer]
        lost, repeated = check.lost, check.repeated
        check.receive(frame.sequence, now)
        counts = self._counts.at(now)
        counts["frames"] += 1
        counts["bytes"] += seen.size
        counts["signed"] += seen.is_signed
        counts["lost"] += check.lost - lost
        counts["repeated"] += check.repeated - repeated
        counts[frame.message_id] += 1
        if frame.message_id in RADIO_STATUS_IDS:
            self._radio = _radio_status(frame.payload)
        elif seen.is_known and isinstance(message := decode(frame), Heartbeat):
            self._heartbeat = message
            self._heartbeat_at = now

    def report(self, address: Address, window: float, now: float) -> ComponentTraffic:
        """Return the present counts; rates are those of `window` seconds."""
        totals, recent = self._counts.totals, self._counts.recent(now)
        received, lost = recent["frames"] - recent["repeated"], max(recent["lost"], 0)
        messages = [
            MessageTraffic(message_name(what), what, count, recent[what] / window)
            for what, count in totals.items()
            if isinstance(what, int)
        ]
        return ComponentTraffic(
            *address,
            version=self._version,
            heartbeat=self._heartbeat,
            heartbeat_age=None if self._heartbeat is None else now - self._heartbeat_at,
            age=now - self._received_at,
            frames=totals["frames"],
            bytes=totals["bytes"],
            frame_rate=recent["frames"] / window,
            byte_rate=recent["bytes"] / window,
            lost=totals["lost"],
            loss=lost / (received + lost) if received > 0 else None,
            repeated=totals["repeated"],
            late=sum(check.late for check in self._checks.values()),
            signed=totals["signed"],
            messages=tuple(sorted(messages, key=lambda each: (-each.rate, -each.count, each.name))),
            radio=self._radio,
        )


_What: TypeAlias = str | int  # a number is a message id


class _Counts:
    """Counts by what is counted, and their increase within the last `RATE_WINDOW` seconds."""

    def __init__(self) -> None:
        self.totals: Counter[_What] = Counter()
        self.began = math.inf
        # the counts before each of the last slices in which something was counted
        self._snapshots: deque[tuple[int, Counter[_What]]] = deque(maxlen=round(RATE_WINDOW / RATE_SLICE))

    def at(self, now: float) -> Counter[_What]:
        """Return the counts, to be increased at this time."""
        number = int(now / RATE_SLICE)
        if not self._snapshots or self._snapshots[-1][0] != number:
            self.began = min(self.began, now)
            self._snapshots.append((number, self.totals.copy()))
        return self.totals

    def recent(self, now: float) -> Counter[_What]:
        first = _first_slice(now)
        before = next((totals for number, totals in self._snapshots if number >= first), self.totals)
        return Counter({what: count - before[what] for what, count in self.totals.items()})


def _first_slice(now: float) -> int:
    """Return the oldest slice within that time."""
    return int(now / RATE_SLICE) - round(RATE_WINDOW / RATE_SLICE) + 1


_RADIO_STATUS = struct.Struct("<HHBBBBB")


def _radio_status(payload: bytes) -> RadioStatus:
    errors, fixed, rssi, remote_rssi, free, noise, remote_noise = _RADIO_STATUS.unpack_from(
        payload.ljust(_RADIO_STATUS.size, b"\0")
    )
    return RadioStatus(rssi, noise, remote_rssi, remote_noise, free, errors, fixed)
