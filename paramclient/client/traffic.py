"""Traffic of a link by component and message: counts, rates and losses."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final

import anyio

from paramclient.client.frame_cutter import SeenFrame, Sniffer
from paramclient.wire.frames import Frame, message_name
from paramclient.wire.loss import SequenceCheck
from paramclient.wire.messages import Heartbeat, decode, message_id

__all__ = ["ComponentTraffic", "MessageTraffic", "RadioStatus", "Traffic", "TrafficReport"]

RATE_WINDOW: Final = 5.0
"""Seconds over which rates and losses are measured: several heartbeats, and short enough to adjust an
antenna."""
RATE_SLICE: Final = 0.5
"""Seconds of one slice of that time."""
RATE_TIME_MIN: Final = 1.0
"""Seconds, at least, over which a rate is computed."""
COUNTED_COMPONENTS_MAX: Final = 1_000
"""Components that are counted separately; frames of further ones count for the link only."""
COUNTED_MESSAGES_MAX: Final = 500
"""Message ids of a component that are counted separately; the dialect has fewer."""
COUNTED_PEERS_MAX: Final = 256
"""Peers with an unfinished frame, and peers of one component with sequence numbers."""
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


class Traffic:
    """Counts all traffic of a link, as a tap; on request only: an ordinary client does without.

    Args:
        is_stream: whether frames may be spread over several chunks.
    """

    def __init__(self, *, is_stream: bool) -> None:
        self._is_stream = is_stream
        self._sniffers: dict[Hashable, Sniffer] = {}
        self._sources: dict[tuple[int, int], _Source] = {}
        self._began: float | None = None
        self._received = _Recently()
        self._sent = _Recently()
        self._frames = 0
        self._unknown = 0
        self._damaged = 0  # this and the next: of removed sniffers
        self._other_bytes = 0

    def received(self, data: bytes, peer: Hashable) -> None:
        """Count received bytes; an empty chunk means the end of the peer's stream."""
        now = anyio.current_time()
        self._begin(now)
        self._received.add(now, len(data))
        key = peer if self._is_stream else None
        sniffer = self._sniffers.get(key)
        if sniffer is None:
            sniffer = self._sniffers[key] = Sniffer(stream=self._is_stream)
            if len(self._sniffers) > COUNTED_PEERS_MAX:
                self._forget(next(iter(self._sniffers)))
        for seen in sniffer.receive(data) if data else self._forget(key):
            self._count(seen, peer, now)

    def sent(self, data: bytes) -> None:
        """Count a sent frame."""
        now = anyio.current_time()
        self._begin(now)
        self._sent.add(now, len(data))

    def pause(self) -> None:
        """End all unfinished frames: the link is down, and they are not continued."""
        for peer in list(self._sniffers):
            self._forget(peer)

    @property
    def lost(self) -> int:
        """Lost frames of all components."""
        return sum(source.lost for source in self._sources.values())

    @property
    def repeated(self) -> int:
        """Frames of all components received twice."""
        return sum(source.repeated for source in self._sources.values())

    def report(self, now: float) -> TrafficReport:
        """Return the present counts."""
        began = now if self._began is None else self._began
        sniffers = self._sniffers.values()
        return TrafficReport(
            seconds=now - began,
            components=tuple(self._sources[address].report(began, now) for address in sorted(self._sources)),
            bytes_received=self._received.total,
            bytes_sent=self._sent.total,
            received_rate=self._received.rate(began, now),
            sent_rate=self._sent.rate(began, now),
            frames=self._frames,
            damaged=self._damaged + sum(each.damaged for each in sniffers),
            unknown=self._unknown,
            other_bytes=self._other_bytes + sum(each.other_bytes for each in sniffers),
        )

    def _begin(self, now: float) -> None:
        if self._began is None:
            self._began = now

    def _forget(self, peer: Hashable) -> list[SeenFrame]:
        """Remove a peer's stream; return the frames in its unfinished end."""
        sniffer = self._sniffers.pop(peer)
        seen = sniffer.flush()
        self._damaged += sniffer.damaged
        self._other_bytes += sniffer.other_bytes
        return seen

    def _count(self, seen: SeenFrame, peer: Hashable, now: float) -> None:
        self._frames += 1
        if not seen.is_known:
            self._unknown += 1
        address = (seen.system, seen.component)
        source = self._sources.get(address)
        if source is None:
            if not seen.is_known or len(self._sources) >= COUNTED_COMPONENTS_MAX:
                return  # an address that no checksum proves does not count
            source = self._sources[address] = _Source(address)
        source.receive(seen, peer, now)


class _Source:
    """One component's frames."""

    def __init__(self, address: tuple[int, int]) -> None:
        self._address = address
        self._bytes = _Recently()
        self._frames = _Recently()
        self._lost = _Recently()
        self._repeated = _Recently()
        self._messages: dict[int, _Recently] = {}
        self._checks: dict[Hashable, SequenceCheck] = {}
        self._signed = 0
        self._version = 1
        self._received_at = 0.0
        self._heartbeat: Heartbeat | None = None
        self._heartbeat_at = 0.0
        self._radio: RadioStatus | None = None
        self._late = 0  # of removed peers

    def receive(self, seen: SeenFrame, peer: Hashable, now: float) -> None:
        self._received_at = now
        self._version = seen.version
        self._signed += seen.is_signed
        self._bytes.add(now, seen.size)
        self._frames.add(now, 1)
        messages = self._messages.get(seen.message_id)
        if messages is None and len(self._messages) < COUNTED_MESSAGES_MAX:
            messages = self._messages[seen.message_id] = _Recently()
        if messages is not None:
            messages.add(now, 1)
        check = self._check(peer)
        lost, repeated = check.lost, check.repeated
        check.receive(seen.sequence, now)
        if (check.lost, check.repeated) != (lost, repeated):
            self._lost.add(now, check.lost - lost)
            self._repeated.add(now, check.repeated - repeated)
        if seen.message_id in RADIO_STATUS_IDS:
            self._radio = _radio_status(seen.payload)
        elif seen.message_id == message_id(Heartbeat) and seen.is_known:
            message = decode(Frame(*seen[:6]))
            assert isinstance(message, Heartbeat)
            self._heartbeat = message
            self._heartbeat_at = now

    @property
    def lost(self) -> int:
        return self._lost.total

    @property
    def repeated(self) -> int:
        return self._repeated.total

    @property
    def is_radio(self) -> bool:
        return self._radio is not None

    def report(self, began: float, now: float) -> ComponentTraffic:
        system, component = self._address
        received = self._frames.recent_total(now) - self._repeated.recent_total(now)
        lost = max(self._lost.recent_total(now), 0)
        messages = [
            MessageTraffic(message_name(number), number, each.total, each.rate(began, now))
            for number, each in self._messages.items()
        ]
        return ComponentTraffic(
            system,
            component,
            version=self._version,
            heartbeat=self._heartbeat,
            heartbeat_age=None if self._heartbeat is None else now - self._heartbeat_at,
            age=now - self._received_at,
            frames=self._frames.total,
            bytes=self._bytes.total,
            frame_rate=self._frames.rate(began, now),
            byte_rate=self._bytes.rate(began, now),
            lost=self._lost.total,
            loss=lost / (received + lost) if received > 0 else None,
            repeated=self._repeated.total,
            late=self._late + sum(check.late for check in self._checks.values()),
            signed=self._signed,
            messages=tuple(sorted(messages, key=lambda each: (-each.rate, -each.count, each.name))),
            radio=self._radio,
        )

    def _check(self, peer: Hashable) -> SequenceCheck:
        check = self._checks.get(peer)
        if check is None:
            check = self._checks[peer] = SequenceCheck()
            if len(self._checks) > COUNTED_PEERS_MAX:
                self._late += self._checks.pop(next(iter(self._checks))).late
        return check


class _Recently:
    """A sum, and its increase within the last `RATE_WINDOW` seconds."""

    __slots__ = ("_slices", "total")

    def __init__(self) -> None:
        self.total = 0
        # number of the slice, sum; the garbage collector visits no tuples of numbers
        self._slices: deque[tuple[int, int]] = deque(maxlen=round(RATE_WINDOW / RATE_SLICE))

    def add(self, now: float, amount: int) -> None:
        self.total += amount
        number = int(now / RATE_SLICE)
        if self._slices and self._slices[-1][0] == number:
            amount += self._slices.pop()[1]
        self._slices.append((number, amount))

    def recent_total(self, now: float) -> int:
        first = _first_slice(now)
        return sum(amount for number, amount in self._slices if number >= first)

    def rate(self, began: float, now: float) -> float:
        """Return the recent increase per second."""
        return self.recent_total(now) / max(now - max(_first_slice(now) * RATE_SLICE, began), RATE_TIME_MIN)


def _first_slice(now: float) -> int:
    """Return the oldest slice within that time."""
    return int(now / RATE_SLICE) - round(RATE_WINDOW / RATE_SLICE) + 1


_RADIO_STATUS = struct.Struct("<HHBBBBB")


def _radio_status(payload: bytes) -> RadioStatus:
    errors, fixed, rssi, remote_rssi, free, noise, remote_noise = _RADIO_STATUS.unpack_from(
        payload.ljust(_RADIO_STATUS.size, b"\0")
    )
    return RadioStatus(rssi, noise, remote_rssi, remote_noise, free, errors, fixed)
